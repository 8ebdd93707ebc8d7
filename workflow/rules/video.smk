rule video:
    input:
        video=video_file,
    output:
        frames=directory("decoded/{dataset}/{seq}"),
        findings="decoded/{dataset}/{seq}.json",
        stats="<results>/{dataset}/{seq}/stats/video.json",
    log:
        "<logs>/{dataset}/{seq}/video.log",
    group:
        submission("poses")
    conda:
        "../envs/motionsplat.yaml"
    threads: 4
    resources:
        mem_mb=video_memory,
        disk_mb=disk("video"),
    params:
        code=code_digest("stages.video"),
        flags=flags("video"),
        shot=lambda wildcards: VIDEO_SHOTS[wildcards.seq].flags,
    shell:
        "{{ python -m stages.video --video {input.video:q} --output {output.frames:q} --findings {output.findings:q}"
        " --indexes decoded/{wildcards.dataset:q}/.index {params.shot} {params.flags}"
        " --log {log:q} --stats {output.stats:q}; }} 2>> {log:q}"
