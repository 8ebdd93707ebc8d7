rule scene:
    input:
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
        masks="<results>/{dataset}/{seq}/masks",
        poses="<results>/{dataset}/{seq}/ba/poses.parquet",
        depth="<results>/{dataset}/{seq}/ba/depth.arrow",
    output:
        scene="<results>/{dataset}/{seq}/scene.json",
        figure="<results>/{dataset}/{seq}/figures/scene.png",
        stats="<results>/{dataset}/{seq}/stats/scene.json",
    log:
        "<logs>/{dataset}/{seq}/scene.log",
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
