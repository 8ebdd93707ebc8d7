rule ba:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=artifact("lens", "lens/pairs.arrow"),
        masks=optional("segment", "masks"),
        previous_poses=optional("ba", "ba/poses.parquet", before=1),
        previous_depth=optional("ba", "ba/depth.arrow", before=1),
        previous_convergence=optional("ba", "ba/convergence.parquet", before=1),
        previous_figure=optional("ba", "figures/ba.png", before=1),
        previous_masks=optional("segment", "masks", before=1),
    output:
        poses="<results>/{dataset}/{seq}/{setting}{round}ba/poses.parquet",
        trajectory="<results>/{dataset}/{seq}/{setting}{round}ba/trajectory.tum",
        depth="<results>/{dataset}/{seq}/{setting}{round}ba/depth.arrow",
        convergence="<results>/{dataset}/{seq}/{setting}{round}ba/convergence.parquet",
        figure="<results>/{dataset}/{seq}/{setting}{round}figures/ba.png",
        stats="<results>/{dataset}/{seq}/{setting}{round}stats/ba.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}{round}ba.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("ba"),
        disk_mb=disk("ba"),
    params:
        code=code_digest("stages.ba"),
        flags=flags("ba"),
        given=given_files("ba"),
        optional=optional_flags(
            *("masks", "previous_poses", "previous_depth"),
            *("previous_convergence", "previous_figure", "previous_masks"),
        ),
    shell:
        "{{ python -m stages.ba --sequence {input.sequence:q} --flow {input.flow:q}"
        " {params.optional} --poses {output.poses:q} --trajectory {output.trajectory:q} --depth {output.depth:q}"
        " --convergence {output.convergence:q} --figure {output.figure:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
