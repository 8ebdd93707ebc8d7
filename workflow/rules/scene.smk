rule scene:
    input:
        sequence=artifact("inspect", "sequence.json"),
        flow=artifact("flow", "flow/pairs.arrow"),
        masks=artifact("segment", "masks"),
        poses=artifact("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
    output:
        scene="<results>/{dataset}/{seq}/{setting}scene.json",
        figure="<results>/{dataset}/{seq}/{setting}figures/scene.png",
        stats="<results>/{dataset}/{seq}/{setting}stats/scene.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}scene.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=megabytes(500, 60),
    params:
        code=code_digest("stages.scene.decide"),
        flags=flags("scene"),
    shell:
        "python -m stages.scene.decide --sequence {input.sequence} --flow {input.flow} --masks {input.masks}"
        " --poses {input.poses} --depth {input.depth} --output {output.scene} --figure {output.figure}"
        " {params.flags} --log {log} --stats {output.stats}"
