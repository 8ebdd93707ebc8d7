rule colmap:
    input:
        sequence=artifact("inspect", "sequence.json"),
    output:
        poses="<results>/{dataset}/{seq}/{setting}colmap/poses.parquet",
        stats="<results>/{dataset}/{seq}/{setting}stats/colmap.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}colmap.log",
    conda:
        "../envs/motionsplat.yaml"
    # No core is kept for it: at the lowest priority it takes what our own stages leave idle, and never delays them.
    threads: 0
    resources:
        mem_mb=colmap_memory,
        colmap=1,
    params:
        code=code_digest("stages.colmap"),
        flags=flags("colmap"),
        masks="",
    shell:
        "OMP_NUM_THREADS=1 nice -n 19 python -m stages.colmap --sequence {input.sequence:q} --output {output.poses:q}"
        " {params.masks} {params.flags} --log {log:q} --stats {output.stats:q} 2>> {log:q}"


# Apart from the rule above, which need not wait for the masks.
use rule colmap as colmap_masked with:
    input:
        sequence=artifact("inspect", "sequence.json"),
        masks=artifact("segment", "masks"),
    output:
        poses="<results>/{dataset}/{seq}/{setting}colmap_masked/poses.parquet",
        stats="<results>/{dataset}/{seq}/{setting}stats/colmap_masked.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}colmap_masked.log",
    params:
        code=code_digest("stages.colmap"),
        flags=flags("colmap"),
        masks=lambda wildcards, input: f"--masks {shlex.quote(input.masks)}",


rule evaluate:
    input:
        sequence=artifact("inspect", "sequence.json"),
        flow=artifact("flow", "flow/pairs.arrow"),
        priors=artifacts("motion", "motion/prior.arrow"),
        masks=artifacts("segment", "masks"),
        poses=artifacts("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
        colmap=artifact("colmap", "colmap/poses.parquet"),
        masked=masked_baseline("colmap_masked/poses.parquet"),
        motion=artifact("control", "control/deformation.safetensors"),
        model=artifact("gaussians", "gaussians/model.safetensors"),
        half=artifact("gaussians", "gaussians/model_half.safetensors"),
        renders=artifact("render", "renders"),
        stage_stats=stage_stats,
        masked_stats=masked_baseline("stats/colmap_masked.json"),
    output:
        poses="<results>/{dataset}/{seq}/{setting}eval/poses.parquet",
        images="<results>/{dataset}/{seq}/{setting}eval/images.parquet",
        masks="<results>/{dataset}/{seq}/{setting}eval/masks.parquet",
        checks="<results>/{dataset}/{seq}/{setting}eval/checks.parquet",
        time="<results>/{dataset}/{seq}/{setting}eval/time.parquet",
        trajectory="<results>/{dataset}/{seq}/{setting}eval/trajectory.parquet",
        frames="<results>/{dataset}/{seq}/{setting}eval/frames.parquet",
        figure=report(
            "<results>/{dataset}/{seq}/{setting}figures/trajectory.png",
            caption="../report/trajectory.rst",
            category="Poses",
            labels={"sequence": "{seq}", "figure": "{setting}trajectory"},
        ),
        stats="<results>/{dataset}/{seq}/{setting}stats/evaluate.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}evaluate.log",
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=memory("evaluate"),
    params:
        code=code_digest("stages.evaluate"),
        flags=flags("evaluate"),
    shell:
        "python -m stages.evaluate --sequence {input.sequence:q} --flow {input.flow:q} --priors {input.priors:q}"
        " --masks {input.masks:q} --poses {input.poses:q} --depth {input.depth:q} --colmap {input.colmap:q}"
        " {input.masked:q} --motion {input.motion:q} --model {input.model:q} --half {input.half:q}"
        " --renders {input.renders:q} --stage-stats {input.stage_stats:q} {input.masked_stats:q}"
        " --poses-table {output.poses:q} --images-table {output.images:q} --masks-table {output.masks:q}"
        " --checks-table {output.checks:q} --time-table {output.time:q} --trajectory-table {output.trajectory:q}"
        " --frames-table {output.frames:q} --figure {output.figure:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q} 2>> {log:q}"


rule report:
    input:
        unpack(asked_tables),
        tables=expand(rules.evaluate.output, seq=SEQUENCES, dataset=DATASET, setting=""),
        published=str(REPO / "workflow/resources/published.yaml"),
        page=expand(
            str(REPO / "stages/report/templates/{file}"),
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
        mem_mb=lambda wildcards, attempt: megabytes("report", Held(), attempt),
    params:
        code=code_digest("stages.report"),
        flags=flags("report"),
        sequences=evaluated_folders,
        comparisons=comparison_flags,
        manifests=(
            "--manifests simulated"
            if CONFIG.dataset == configuration.SIMULATED
            else ""
        ),
    shell:
        "python -m stages.report --sequences {params.sequences:q} --published-numbers {input.published:q}"
        " {params.manifests} {params.comparisons} --output {output.html:q} --tables {output.tables:q} {params.flags}"
        " --log {log:q} 2>> {log:q}"
