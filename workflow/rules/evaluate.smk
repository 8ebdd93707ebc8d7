rule evaluate:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
        flow=artifact("lens", "lens/pairs.arrow"),
        priors=artifacts("motion", "motion/prior.arrow"),
        masks=artifacts("segment", "masks"),
        poses=artifacts("ba", "ba/poses.parquet"),
        depth=artifact("ba", "ba/depth.arrow"),
        colmap=artifact("colmap", "colmap/poses.parquet"),
        masked=masked_baseline("colmap_masked/poses.parquet"),
        deformation=artifact("control", "control/deformation.safetensors"),
        model=artifact("gaussians", "gaussians/model.safetensors"),
        half=artifact("gaussians", "gaussians/model_half.safetensors"),
        renders=artifact("render", "renders"),
        stage_stats=stage_stats,
        lens=artifact("lens", "lens/lens.json"),
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
        "{{ python -m stages.evaluate --sequence {input.sequence:q} --flow {input.flow:q} --priors {input.priors:q}"
        " --masks {input.masks:q} --poses {input.poses:q} --depth {input.depth:q} --colmap {input.colmap:q}"
        " {input.masked:q} --deformation {input.deformation:q} --model {input.model:q} --half {input.half:q}"
        " --renders {input.renders:q} --stage-stats {input.stage_stats:q} {input.masked_stats:q}"
        " --poses-table {output.poses:q} --images-table {output.images:q} --masks-table {output.masks:q}"
        " --checks-table {output.checks:q} --time-table {output.time:q} --trajectory-table {output.trajectory:q}"
        " --frames-table {output.frames:q} --figure {output.figure:q} --lens {input.lens:q} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
