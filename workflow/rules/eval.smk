ROUNDS = [*(f"round{number}/" for number in range(1, CONFIG.rounds)), ""]


rule colmap:
    input:
        sequence=rules.inspect.output.sequence,
    output:
        poses="<results>/{dataset}/{seq}/colmap/poses.parquet",
        stats="<results>/{dataset}/{seq}/stats/colmap.json",
    log:
        "<logs>/{dataset}/{seq}/colmap.log",
    # On one thread it would hold back every stage that wants all cores: it waits for them instead.
    priority: -1
    conda:
        "../envs/motionsplat.yaml"
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
        priors=expand(
            "<results>/{{dataset}}/{{seq}}/{round}motion/prior.arrow", round=ROUNDS
        ),
        masks=expand("<results>/{{dataset}}/{{seq}}/{round}masks", round=ROUNDS),
        poses=expand(
            "<results>/{{dataset}}/{{seq}}/{round}ba/poses.parquet", round=ROUNDS
        ),
        depth="<results>/{dataset}/{seq}/ba/depth.arrow",
        colmap=rules.colmap.output.poses,
        renders=rules.render.output.renders,
        stage_stats=stage_stats,
    output:
        poses="<results>/{dataset}/{seq}/eval/poses.parquet",
        images="<results>/{dataset}/{seq}/eval/images.parquet",
        masks="<results>/{dataset}/{seq}/eval/masks.parquet",
        checks="<results>/{dataset}/{seq}/eval/checks.parquet",
        time="<results>/{dataset}/{seq}/eval/time.parquet",
        trajectory="<results>/{dataset}/{seq}/eval/trajectory.parquet",
        frames="<results>/{dataset}/{seq}/eval/frames.parquet",
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
        "python -m stages.eval.evaluate --sequence {input.sequence} --flow {input.flow} --priors {input.priors}"
        " --masks {input.masks} --poses {input.poses} --depth {input.depth} --colmap {input.colmap}"
        " --renders {input.renders} --stage-stats {input.stage_stats} --poses-table {output.poses}"
        " --images-table {output.images} --masks-table {output.masks} --checks-table {output.checks}"
        " --time-table {output.time} --trajectory-table {output.trajectory} --frames-table {output.frames}"
        " --figure {output.figure} {params.flags} --log {log} --stats {output.stats}"


rule report:
    input:
        tables=expand(rules.evaluate.output, seq=SEQUENCES, dataset=DATASET),
        published=str(REPO / "workflow/resources/published.yaml"),
        page=expand(
            str(REPO / "stages/eval/templates/{file}"),
            file=["report.html.j2", "style.css", "sort.js"],
        ),
    output:
        html=report(
            f"<results>/{DATASET}/report/index.html",
            caption="../report/report.rst",
            category="Report",
        ),
        tables=directory(f"<results>/{DATASET}/report/tables"),
    log:
        f"<logs>/{DATASET}/report.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=1500,
    params:
        code=code_digest("stages.eval.report"),
        flags=flags("report"),
        sequences=evaluated_folders,
        manifests="--manifests simulated" if DATASET == settings.SIMULATED else "",
    shell:
        "python -m stages.eval.report --sequences {params.sequences} --published-numbers {input.published}"
        " {params.manifests} --output {output.html} --tables {output.tables} {params.flags} --log {log}"
