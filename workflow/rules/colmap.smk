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
    # No core is reserved: COLMAP runs at the lowest priority, uses cores that our stages leave idle, and delays none.
    threads: 0
    resources:
        mem_mb=colmap_memory,
        colmap=1,
    params:
        code=code_digest("stages.colmap"),
        flags=flags("colmap"),
        masks="",
    shell:
        "{{ OMP_NUM_THREADS=1 nice -n 19 python -m stages.colmap --sequence {input.sequence:q} --output {output.poses:q}"
        " {params.masks} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"


# A rule of its own: COLMAP without masks need not wait for the masks.
use rule colmap as colmap_masked with:
    input:
        sequence=artifact("lens", "lens/sequence.json"),
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
