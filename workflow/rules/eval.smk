rule colmap:
    input:
        sequence=rules.inspect.output.sequence,
    output:
        poses="<results>/{dataset}/{seq}/colmap/poses.parquet",
        stats="<results>/{dataset}/{seq}/stats/colmap.json",
    log:
        "<logs>/{dataset}/{seq}/colmap.log",
    conda:
        "../envs/motionsplat.yaml"
    threads: 2
    resources:
        mem_mb=megabytes(800, 60),
    params:
        code=code_digest("stages.eval.colmap"),
        flags=flags("colmap"),
    shell:
        "python -m stages.eval.colmap --sequence {input.sequence} --output {output.poses}"
        " {params.flags} --log {log} --stats {output.stats}"


rule evaluate:
    input:
        sequence=rules.inspect.output.sequence,
        flow=rules.flow.output.flow,
        masks="<results>/{dataset}/{seq}/masks",
        poses="<results>/{dataset}/{seq}/ba/poses.parquet",
        depth="<results>/{dataset}/{seq}/ba/depth.arrow",
        colmap=rules.colmap.output.poses,
        renders=rules.render.output.renders,
        stage_stats=stage_stats,
    output:
        poses="<results>/{dataset}/{seq}/eval/poses.parquet",
        images="<results>/{dataset}/{seq}/eval/images.parquet",
        masks="<results>/{dataset}/{seq}/eval/masks.parquet",
        time="<results>/{dataset}/{seq}/eval/time.parquet",
        figure=report(
            "<results>/{dataset}/{seq}/figures/trajectory.png",
            caption="../report/trajectory.rst",
            category="Poses",
            labels={"sequence": "{seq}", "figure": "trajectory"},
        ),
        stats="<results>/{dataset}/{seq}/stats/evaluate.json",
    log:
        "<logs>/{dataset}/{seq}/evaluate.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=megabytes(600, 60),
    params:
        code=code_digest("stages.eval.evaluate"),
        flags=flags("evaluate"),
    shell:
        "python -m stages.eval.evaluate --sequence {input.sequence} --flow {input.flow} --masks {input.masks}"
        " --poses {input.poses} --depth {input.depth} --colmap {input.colmap} --renders {input.renders}"
        " --stage-stats {input.stage_stats} --poses-table {output.poses} --images-table {output.images}"
        " --masks-table {output.masks} --time-table {output.time} --figure {output.figure}"
        " {params.flags} --log {log} --stats {output.stats}"


rule report:
    input:
        tables=expand(rules.evaluate.output, seq=SEQUENCES, dataset=DATASET),
        published=workflow.source_path("../resources/published.yaml"),
    output:
        html=report(
            f"<results>/{DATASET}/report/index.html",
            caption="../report/report.rst",
            category="Report",
        ),
    log:
        f"<logs>/{DATASET}/report.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=1500,
    params:
        code=code_digest("stages.eval.report"),
        flags=flags("report"),
        sequences=expand("<results>/{dataset}/{seq}", seq=SEQUENCES, dataset=DATASET),
    shell:
        "python -m stages.eval.report --sequences {params.sequences} --published {input.published}"
        " --output {output.html} {params.flags} --log {log}"
