rule simulate:
    input:
        scene=scene_file,
    output:
        manifest="simulated/{seq}.json",
        stats="<results>/simulated/{seq}/stats/simulate.json",
    log:
        "<logs>/simulated/{seq}/simulate.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("simulate"),
        disk_mb=disk("simulate"),
    params:
        code=code_digest("stages.simulate"),
        flags=flags("simulate"),
    shell:
        "{{ python -m stages.simulate --scene {input.scene:q} --output simulated {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
