rule control:
    input:
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
        masks="<results>/{dataset}/{seq}/masks",
        poses="<results>/{dataset}/{seq}/ba/poses.parquet",
        depth="<results>/{dataset}/{seq}/ba/depth.arrow",
        scene=rules.scene.output.scene,
    output:
        points="<results>/{dataset}/{seq}/control/points.parquet",
        deformation="<results>/{dataset}/{seq}/control/deformation.safetensors",
        figure="<results>/{dataset}/{seq}/figures/control.png",
        stats="<results>/{dataset}/{seq}/stats/control.json",
    log:
        "<logs>/{dataset}/{seq}/control.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(1200, 60),
    params:
        code=code_digest("stages.control.fit"),
        flags=flags("control"),
    shell:
        "python -m stages.control.fit --sequence {input.sequence} --flow {input.flow} --masks {input.masks}"
        " --poses {input.poses} --depth {input.depth} --scene {input.scene} --points {output.points}"
        " --deformation {output.deformation} --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"
