rule lens:
    input:
        sequence=artifact("inspect", "sequence.json"),
        flow=artifact("flow", "flow/pairs.arrow"),
    output:
        # The first: Snakemake touches outputs one by one, and this may be another name of the input, newer then than others.
        pairs=of_flow("<results>/{dataset}/{seq}/{setting}lens/pairs.arrow"),
        sequence="<results>/{dataset}/{seq}/{setting}lens/sequence.json",
        images=directory("<results>/{dataset}/{seq}/{setting}lens/images"),
        lens="<results>/{dataset}/{seq}/{setting}lens/lens.json",
        stats="<results>/{dataset}/{seq}/{setting}stats/lens.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}lens.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=memory("lens"),
    params:
        code=code_digest("stages.lens"),
        flags=flags("lens"),
    shell:
        "{{ python -m stages.lens --sequence {input.sequence:q} --flow {input.flow:q}"
        " --undistorted {output.sequence:q} --pairs {output.pairs:q} --images {output.images:q} --lens {output.lens:q}"
        " {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
