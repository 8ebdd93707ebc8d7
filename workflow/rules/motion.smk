rule motion:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=artifact("lens", "lens/pairs.arrow"),
        previous_poses=optional("ba", "ba/poses.parquet", before=1),
        previous_depth=optional("ba", "ba/depth.arrow", before=1),
        previous_prior=optional("motion", "motion/prior.arrow", before=1, since=4),
        previous_figure=optional("motion", "figures/motion.png", before=1, since=4),
        earlier_poses=optional("ba", "ba/poses.parquet", before=2, since=4),
        earlier_depth=optional("ba", "ba/depth.arrow", before=2, since=4),
    output:
        prior="<results>/{dataset}/{seq}/{setting}{round}motion/prior.arrow",
        figure="<results>/{dataset}/{seq}/{setting}{round}figures/motion.png",
        stats="<results>/{dataset}/{seq}/{setting}{round}stats/motion.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}{round}motion.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("motion"),
        disk_mb=disk("motion"),
    params:
        code=code_digest("stages.motion"),
        flags=flags("motion"),
        previous=optional_flags(
            *("previous_poses", "previous_depth", "previous_prior", "previous_figure"),
            *("earlier_poses", "earlier_depth"),
        ),
    shell:
        "{{ python -m stages.motion --sequence {input.sequence:q} --flow {input.flow:q} {params.previous}"
        " --output {output.prior:q} --figure {output.figure:q} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
