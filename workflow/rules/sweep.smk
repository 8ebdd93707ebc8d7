# The same sequences under other settings: accuracy against time (sweep) and growth of the cost (scaling).
RUNS = {
    "sweep": [
        compared_runs.swept_run(EVERY_SETTING, setting, name)
        for name in SWEPT_SEQUENCES
        for setting in SWEPT
        if can_run(name, setting)
    ],
    "scaling": [
        compared_runs.scaled_run(EVERY_SETTING, setting, name)
        for name in SCALED_SEQUENCES
        for setting in sizes.distinct(CONFIGURED, SCALED, SEQUENCES[name])[0]
        if can_run(name, setting)
    ],
}


rule list_runs:
    output:
        runs=f"<results>/{DATASET}/{{comparison}}/runs.json",
    log:
        f"<logs>/{DATASET}/{{comparison}}_runs.log",
    wildcard_constraints:
        comparison="sweep|scaling",
    localrule: True
    params:
        runs=lambda wildcards: listed_runs(wildcards.comparison),
    run:
        write_json(Path(output.runs), {"runs": params.runs})


rule collect_sweep:
    input:
        needed_by(RUNS["sweep"]),
        runs=f"<results>/{DATASET}/sweep/runs.json",
    output:
        table=TABLES["sweep"],
    log:
        f"<logs>/{DATASET}/sweep.log",
    conda:
        "../envs/motionsplat.yaml"
    params:
        code=code_digest("stages.comparisons.sweep"),
    shell:
        "{{ python -m stages.comparisons.sweep --runs {input.runs:q} --output {output.table:q} --log {log:q}; }} 2>> {log:q}"


rule collect_scaling:
    input:
        needed_by(RUNS["scaling"]),
        runs=f"<results>/{DATASET}/scaling/runs.json",
    output:
        table=TABLES["scaling"],
    log:
        f"<logs>/{DATASET}/scaling.log",
    conda:
        "../envs/motionsplat.yaml"
    params:
        code=code_digest("stages.comparisons.scaling"),
    shell:
        "{{ python -m stages.comparisons.scaling --runs {input.runs:q} --output {output.table:q} --log {log:q}; }} 2>> {log:q}"
