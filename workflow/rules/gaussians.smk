rule train:
    input:
        sequence=rules.inspect.output.sequence,
        masks="<results>/{dataset}/{seq}/masks",
        poses="<results>/{dataset}/{seq}/ba/poses.parquet",
        depth="<results>/{dataset}/{seq}/ba/depth.arrow",
        scene=rules.scene.output.scene,
        points=rules.control.output.points,
        deformation=rules.control.output.deformation,
    output:
        ply="<results>/{dataset}/{seq}/gaussians/gaussians.ply",
        model="<results>/{dataset}/{seq}/gaussians/model.safetensors",
        convergence="<results>/{dataset}/{seq}/gaussians/convergence.parquet",
        figure="<results>/{dataset}/{seq}/figures/gaussians.png",
        stats="<results>/{dataset}/{seq}/stats/gaussians.json",
    log:
        "<logs>/{dataset}/{seq}/gaussians.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(1500, 60),
        gpu=1,
    params:
        code=code_digest("stages.gaussians.train"),
        flags=flags("gaussians"),
    shell:
        "python -m stages.gaussians.train --sequence {input.sequence} --masks {input.masks} --poses {input.poses}"
        " --depth {input.depth} --scene {input.scene} --points {input.points} --deformation {input.deformation}"
        " --ply {output.ply} --model {output.model} --convergence {output.convergence} --figure {output.figure}"
        " {params.flags} --log {log} --stats {output.stats}"


rule render:
    input:
        sequence=rules.inspect.output.sequence,
        poses="<results>/{dataset}/{seq}/ba/poses.parquet",
        model=rules.train.output.model,
    output:
        renders=directory("<results>/{dataset}/{seq}/renders"),
        video=report(
            "<results>/{dataset}/{seq}/figures/render.gif",
            caption="../report/render.rst",
            category="Rendering",
            labels={"sequence": "{seq}", "figure": "fly-through"},
        ),
        stats="<results>/{dataset}/{seq}/stats/render.json",
    log:
        "<logs>/{dataset}/{seq}/render.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(1000, 10),
        gpu=1,
    params:
        code=code_digest("stages.gaussians.render"),
        flags=flags("render"),
    shell:
        "python -m stages.gaussians.render --sequence {input.sequence} --poses {input.poses} --model {input.model}"
        " --output {output.renders} --video {output.video} {params.flags} --log {log} --stats {output.stats}"
