rule segment:
    input:
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
        prior=rules.motion.output.prior,
    output:
        masks=directory("<results>/{dataset}/{seq}/{round}masks"),
        figure="<results>/{dataset}/{seq}/{round}figures/segment.png",
        stats="<results>/{dataset}/{seq}/{round}stats/segment.json",
    log:
        "<logs>/{dataset}/{seq}/{round}segment.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=megabytes(500, 60),
    params:
        code=code_digest("stages.segment.refine"),
        flags=flags("segment"),
    shell:
        "python -m stages.segment.refine --sequence {input.sequence} --flow {input.flow} --prior {input.prior}"
        " --output {output.masks} --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"
