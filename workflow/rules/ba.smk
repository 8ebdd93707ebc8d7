rule ba:
    input:
        unpack(previous_cameras),
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
        masks=rules.segment.output.masks,
    output:
        poses="<results>/{dataset}/{seq}/{round}ba/poses.parquet",
        trajectory="<results>/{dataset}/{seq}/{round}ba/trajectory.tum",
        depth="<results>/{dataset}/{seq}/{round}ba/depth.arrow",
        convergence="<results>/{dataset}/{seq}/{round}ba/convergence.parquet",
        figure="<results>/{dataset}/{seq}/{round}figures/ba.png",
        stats="<results>/{dataset}/{seq}/{round}stats/ba.json",
    log:
        "<logs>/{dataset}/{seq}/{round}ba.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(800, 100),
    params:
        code=code_digest("stages.ba.solve"),
        flags=flags("ba"),
        previous=previous_flags,
    shell:
        "python -m stages.ba.solve --sequence {input.sequence} --flow {input.flow} --masks {input.masks}"
        " {params.previous} --poses {output.poses} --trajectory {output.trajectory} --depth {output.depth}"
        " --convergence {output.convergence} --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"
