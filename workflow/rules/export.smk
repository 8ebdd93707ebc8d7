rule export_sequence:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        poses=artifact("ba", "ba/poses.parquet"),
        masks=artifact("segment", "masks"),
        depth=artifact("ba", "ba/depth.arrow"),
        model=for_formats("gaussians", "gaussians/model.safetensors", "ply", "spz"),
        renders=for_formats("render", "renders", "video"),
        lens=for_formats("lens", "lens/lens.json", "colmap"),
    output:
        folder=directory("<results>/{dataset}/{seq}/export"),
        stats="<results>/{dataset}/{seq}/stats/export.json",
    log:
        "<logs>/{dataset}/{seq}/export.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=memory("export"),
    params:
        code=code_digest("stages.export"),
        flags=flags("export"),
        optional=optional_flags("model", "renders", "lens"),
    shell:
        "{{ python -m stages.export --sequence {input.sequence:q} --poses {input.poses:q} --masks {input.masks:q}"
        " --depth {input.depth:q} {params.optional} --output {output.folder:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
