# motionsplat: from one video of a moving scene to poses, masks, depth and 4D Gaussians. See README.md.
from snakemake.utils import min_version

min_version("9.19")


configfile: f"{workflow.basedir}/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/jobs.smk"
include: "workflow/rules/resources.smk"
include: "workflow/rules/compare.smk"
include: "workflow/rules/simulate.smk"
include: "workflow/rules/video.smk"
include: "workflow/rules/inspect.smk"
include: "workflow/rules/flow.smk"
include: "workflow/rules/lens.smk"
include: "workflow/rules/motion.smk"
include: "workflow/rules/segment.smk"
include: "workflow/rules/ba.smk"
include: "workflow/rules/scene.smk"
include: "workflow/rules/control.smk"
include: "workflow/rules/gaussians.smk"
include: "workflow/rules/render.smk"
include: "workflow/rules/export.smk"
include: "workflow/rules/viewer.smk"
include: "workflow/rules/colmap.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/sweep.smk"
include: "workflow/rules/report.smk"


localrules:
    all,
    poses,
    masks,
    splats,
    export,
    scenes,
    view,
    sweep,
    scaling,


onstart:
    tell_disk(workflow.dag.needrun_jobs())


rule all:
    default_target: True
    input:
        rules.report.output,


rule poses:
    input:
        expand(
            "<results>/{dataset}/{seq}/ba/poses.parquet",
            dataset=DATASET,
            seq=SEQUENCES,
        ),


rule masks:
    input:
        expand("<results>/{dataset}/{seq}/masks", dataset=DATASET, seq=SEQUENCES),


rule splats:
    input:
        expand(
            "<results>/{dataset}/{seq}/gaussians/gaussians.ply",
            dataset=DATASET,
            seq=SEQUENCES,
        ),


rule export:
    input:
        expand("<results>/{dataset}/{seq}/export", dataset=DATASET, seq=SEQUENCES),


rule scenes:
    input:
        SCENE_PAGES,


rule view:
    input:
        SCENE_PAGES,
    log:
        f"<logs>/{DATASET}/view.log",
    run:
        open_page(input)


rule sweep:
    input:
        TABLES["sweep"],
        rules.report.output,


rule scaling:
    input:
        TABLES["scaling"],
        rules.report.output,
