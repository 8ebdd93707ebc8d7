rule control:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=artifact("lens", "lens/pairs.arrow"),
        masks=artifact("segment", "masks"),
        poses=artifact("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
        scene=artifact("scene", "scene.json"),
    output:
        points="<results>/{dataset}/{seq}/{setting}control/points.parquet",
        deformation="<results>/{dataset}/{seq}/{setting}control/deformation.safetensors",
        figure="<results>/{dataset}/{seq}/{setting}figures/control.png",
        stats="<results>/{dataset}/{seq}/{setting}stats/control.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}control.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("control"),
        disk_mb=disk("control"),
    params:
        code=code_digest("stages.control"),
        flags=flags("control"),
    shell:
        "{{ python -m stages.control --sequence {input.sequence:q} --flow {input.flow:q} --masks {input.masks:q}"
        " --poses {input.poses:q} --depth {input.depth:q} --scene {input.scene:q} --points {output.points:q}"
        " --deformation {output.deformation:q} --figure {output.figure:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
