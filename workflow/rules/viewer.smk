rule viewer:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        masks=artifact("segment", "masks"),
        poses=artifact("ba", "ba/poses.parquet"),
        model=artifact("gaussians", "gaussians/model.safetensors"),
        page=page_parts("viewer"),
    output:
        scene="<results>/{dataset}/{seq}/{setting}gaussians/scene.html",
        stats="<results>/{dataset}/{seq}/{setting}stats/viewer.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}viewer.log",
    group:
        submission("gaussians")
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=memory("viewer"),
        disk_mb=disk("viewer"),
    params:
        code=code_digest("stages.viewer"),
    shell:
        "{{ python -m stages.viewer --sequence {input.sequence:q} --masks {input.masks:q} --poses {input.poses:q}"
        " --model {input.model:q} --output {output.scene:q} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
