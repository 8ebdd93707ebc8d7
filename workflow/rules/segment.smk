rule segment:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=for_estimated_masks("lens", "lens/pairs.arrow"),
        prior=for_estimated_masks("motion", "motion/prior.arrow"),
        previous_poses=for_estimated_masks("ba", "ba/poses.parquet", before=1),
        previous_depth=for_estimated_masks("ba", "ba/depth.arrow", before=1),
        previous_masks=for_estimated_masks("segment", "masks", before=1, since=4),
        previous_figure=for_estimated_masks(
            "segment", "figures/segment.png", before=1, since=4
        ),
        earlier_poses=for_estimated_masks("ba", "ba/poses.parquet", before=2, since=4),
        earlier_depth=for_estimated_masks("ba", "ba/depth.arrow", before=2, since=4),
    output:
        masks=directory("<results>/{dataset}/{seq}/{setting}{round}masks"),
        figure="<results>/{dataset}/{seq}/{setting}{round}figures/segment.png",
        stats="<results>/{dataset}/{seq}/{setting}{round}stats/segment.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}{round}segment.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("segment"),
        disk_mb=disk("segment"),
    params:
        code=code_digest("stages.segment"),
        flags=flags("segment"),
        estimated=optional_flags(
            *("flow", "prior", "previous_poses", "previous_depth", "previous_masks"),
            *("previous_figure", "earlier_poses", "earlier_depth"),
        ),
        given=given_files("segment"),
    shell:
        "{{ python -m stages.segment --sequence {input.sequence:q} {params.estimated}"
        " --output {output.masks:q} --figure {output.figure:q} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
