rule render:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        poses=artifact("ba", "ba/poses.parquet"),
        model=artifact("gaussians", "gaussians/model.safetensors"),
    output:
        renders=directory("<results>/{dataset}/{seq}/{setting}renders"),
        video=report(
            "<results>/{dataset}/{seq}/{setting}figures/render.gif",
            caption="../report/render.rst",
            category="Rendering",
            labels={"sequence": "{seq}", "figure": "{setting}fly-through"},
        ),
        stats="<results>/{dataset}/{seq}/{setting}stats/render.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}render.log",
    group:
        submission("gaussians")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("render"),
        disk_mb=disk("render"),
        gpu=gpus("render"),
    params:
        code=code_digest("stages.render"),
        flags=flags("render"),
    shell:
        "{{ python -m stages.render --sequence {input.sequence:q} --poses {input.poses:q}"
        " --model {input.model:q} --output {output.renders:q} --video {output.video:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
