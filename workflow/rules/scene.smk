rule scene:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=artifact("lens", "lens/pairs.arrow"),
        masks=artifact("segment", "masks"),
        poses=artifact("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
        lens=artifact("lens", "lens/lens.json"),
    output:
        scene="<results>/{dataset}/{seq}/{setting}scene.json",
        figure="<results>/{dataset}/{seq}/{setting}figures/scene.png",
        stats="<results>/{dataset}/{seq}/{setting}stats/scene.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}scene.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=memory("scene"),
    params:
        code=code_digest("stages.scene"),
        flags=flags("scene"),
    shell:
        "{{ python -m stages.scene --sequence {input.sequence:q} --flow {input.flow:q} --masks {input.masks:q}"
        " --poses {input.poses:q} --depth {input.depth:q} --lens {input.lens:q}"
        " --output {output.scene:q} --figure {output.figure:q} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
