rule gaussians:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        masks=artifact("segment", "masks"),
        poses=artifact("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
        scene=artifact("scene", "scene.json"),
        points=artifact("control", "control/points.parquet"),
        deformation=artifact("control", "control/deformation.safetensors"),
    output:
        ply="<results>/{dataset}/{seq}/{setting}gaussians/gaussians.ply",
        model="<results>/{dataset}/{seq}/{setting}gaussians/model.safetensors",
        half="<results>/{dataset}/{seq}/{setting}gaussians/model_half.safetensors",
        convergence="<results>/{dataset}/{seq}/{setting}gaussians/convergence.parquet",
        figure="<results>/{dataset}/{seq}/{setting}figures/gaussians.png",
        stats="<results>/{dataset}/{seq}/{setting}stats/gaussians.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}gaussians.log",
    group:
        submission("gaussians")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("gaussians"),
        disk_mb=disk("gaussians"),
        gpu=gpus("gaussians"),
    params:
        code=code_digest("stages.gaussians"),
        flags=flags("gaussians"),
    shell:
        "{{ python -m stages.gaussians --sequence {input.sequence:q} --masks {input.masks:q} --poses {input.poses:q}"
        " --depth {input.depth:q} --scene {input.scene:q} --points {input.points:q}"
        " --deformation {input.deformation:q} --ply {output.ply:q} --model {output.model:q} --half {output.half:q}"
        " --convergence {output.convergence:q} --figure {output.figure:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
