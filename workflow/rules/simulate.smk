rule simulate:
    input:
        scene=scene_file,
    output:
        manifest="simulated/{seq}.json",
    log:
        "<logs>/simulated/{seq}/simulate.log",
    params:
        code=code_digest("stages.simulate.render"),
        flags=flags("simulate"),
    resources:
        mem_mb=megabytes(600, 0),
    threads: 4
    shell:
        "python -m stages.simulate.render --scene {input.scene} --output simulated {params.flags} --log {log}"
