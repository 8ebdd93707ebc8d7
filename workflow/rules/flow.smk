rule flow:
    input:
        sequence=rules.inspect.output.sequence,
    output:
        flow="<results>/{dataset}/{seq}/flow/pairs.arrow",
        figure="<results>/{dataset}/{seq}/figures/flow.png",
        stats="<results>/{dataset}/{seq}/stats/flow.json",
    log:
        "<logs>/{dataset}/{seq}/flow.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(500, 60),
    params:
        code=code_digest("stages.flow.estimate"),
        flags=flags("flow"),
    shell:
        "python -m stages.flow.estimate --sequence {input.sequence} --output {output.flow}"
        " --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"


rule motion:
    input:
        unpack(previous_cameras),
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
    output:
        prior="<results>/{dataset}/{seq}/{round}motion/prior.arrow",
        figure="<results>/{dataset}/{seq}/{round}figures/motion.png",
        stats="<results>/{dataset}/{seq}/{round}stats/motion.json",
    log:
        "<logs>/{dataset}/{seq}/{round}motion.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(600, 60),
    params:
        code=code_digest("stages.flow.motion"),
        flags=flags("motion"),
        previous=previous_flags,
    shell:
        "python -m stages.flow.motion --sequence {input.sequence} --flow {input.flow} {params.previous}"
        " --output {output.prior} --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"
