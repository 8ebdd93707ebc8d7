rule flow:
    input:
        sequence=artifact("inspect", "sequence.json"),
    output:
        flow=of_flow("<results>/{dataset}/{seq}/{setting}flow/pairs.arrow"),
        figure="<results>/{dataset}/{seq}/{setting}figures/flow.png",
        stats="<results>/{dataset}/{seq}/{setting}stats/flow.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}flow.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("flow"),
        disk_mb=disk("flow"),
    params:
        code=code_digest("stages.flow"),
        flags=flags("flow"),
        given=given_files("flow"),
    shell:
        "{{ python -m stages.flow --sequence {input.sequence:q} --output {output.flow:q}"
        " --figure {output.figure:q} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
