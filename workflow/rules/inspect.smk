rule inspect:
    input:
        unpack(frame_source),
        burnt_in=burnt_in_mask,
    output:
        sequence="<results>/{dataset}/{seq}/{setting}sequence.json",
        figure=report(
            "<results>/{dataset}/{seq}/{setting}figures/inspect.png",
            caption="../report/inspect.rst",
            category="Input",
            labels={"sequence": "{seq}", "figure": "{setting}frames"},
        ),
        stats="<results>/{dataset}/{seq}/{setting}stats/inspect.json",
    log:
        "<logs>/{dataset}/{seq}/{setting}inspect.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    resources:
        mem_mb=memory("inspect"),
    params:
        code=code_digest("stages.inspect"),
        folder=frame_folder,
        times=frame_times,
        flags=flags("inspect"),
        video=optional_flags("video"),
        part=part_flags,
    shell:
        "{{ python -m stages.inspect --frames {params.folder:q} --output {output.sequence:q}"
        " --figure {output.figure:q} {params.video} {params.part} {params.flags} --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
