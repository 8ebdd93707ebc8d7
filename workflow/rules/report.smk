rule report:
    input:
        unpack(asked_tables),
        tables=expand(rules.evaluate.output, seq=SEQUENCES, dataset=DATASET, setting=""),
        scenes=SCENE_PAGES,
        published=str(REPO / "workflow/resources/published.yaml"),
        page=page_parts("report"),
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
        "{{ python -m stages.report --sequences {params.sequences:q} --published-numbers {input.published:q}"
        " {params.manifests} {params.comparisons} --output {output.html:q} --tables {output.tables:q} {params.flags}"
        " --log {log:q}; }} 2>> {log:q}"
