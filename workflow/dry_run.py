"""The rules of the workflow with the files that they hand to each other, as Snakemake itself plans it in a dry run."""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

REPO = Path(__file__).parents[1]
PLAN = ("-n", "-p", "sweep", "scaling", "export", "--configfile")
OPTIONS = {"dataset": "simulated", "scenes": ["demo"], "colmap": {"upsample_masked": [1]}}
"""Everything there is, on one scene of the library."""
FROM_VIDEO = ("-n", "-p", "results/demo/demo/sequence.json", "--configfile")
"""What is before all else if the dataset is a video."""
LEFT_OUT = ("stats/", "figures/")
"""What every rule writes beside its artifacts: time and memory, and a picture for the report."""


@dataclass(eq=False)
class Rule:
    """A rule over all of its jobs: what it makes, and what it reads of what other rules make.

    Attributes:
        script: the module that it runs, "" for one that runs none.
        outputs: names of its artifacts within the folder of a sequence or of the dataset, in the rule's order.
        inputs: artifacts that it reads. before: those that it reads from the round before.
        repeated: whether rounds repeat it. jobs: what the dry run says of each.
    """

    name: str
    script: str
    outputs: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    repeated: bool = False
    jobs: list[str] = field(default_factory=list)


def planned_rules() -> list[Rule]:
    """Every rule that makes a file, readers after makers, from a dry run of the workflow in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "demo.mp4"
        _encode(video)
        plan = _dry_run(folder, PLAN, OPTIONS)
        before = _dry_run(folder, FROM_VIDEO, {"dataset": str(video)})
    return _in_order(_read_plan(plan + before.replace("results/demo/", "results/simulated/")))


def _dry_run(folder: str, arguments: Iterable[str], options: Mapping[str, object]) -> str:
    """What Snakemake says of a plan under these options."""
    asked = Path(folder) / "asked.json"
    asked.write_text(json.dumps(options))
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(REPO / "Snakefile"), "--directory", folder]
    plan = subprocess.run([*command, *arguments, str(asked)], cwd=REPO, capture_output=True, text=True, check=True)
    return plan.stdout + plan.stderr


def _encode(path: Path) -> None:
    """A video of a few frames of growing brightness."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25, width=64, height=48, pix_fmt="yuv420p")
        for level in (40, 80, 120, 160):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def described(rules: Iterable[Rule]) -> str:
    """One line per rule: what it runs, reads and writes."""
    lines = []
    for rule in rules:
        read = ", ".join(sorted(rule.inputs) + [f"{name} of the round before" for name in sorted(rule.before)])
        lines.append(f"{rule.name} ({rule.script}): {read} -> {', '.join(rule.outputs)}")
    return "\n".join(lines)


def _read_plan(text: str) -> dict[str, Rule]:
    """The rules in the words of a dry run, merged over the jobs of the configured run; a sweep's others are alike."""
    jobs = sorted(re.split(r"^ *(?=(?:local)?rule \w+:)", text, flags=re.MULTILINE)[1:])
    rules: dict[str, Rule] = {}
    for job in jobs:
        name, made = job.partition(":")[0].split()[-1], _listed(job, "output").split(", ")
        if any(map(_artifact, made)) and "/settings/" not in made[0]:
            script = re.search(r"python -m (stages[\w.]+)", job)
            rule = rules.setdefault(name, Rule(name, script[1] if script else ""))
            _add(rule.outputs, map(_artifact, made))
            rule.jobs.append(job)
    known = {artifact for rule in rules.values() for artifact in rule.outputs}
    for rule in rules.values():
        rule.repeated = any(_round(_listed(job, "output")) for job in rule.jobs)
        for job in rule.jobs:
            for path in _listed(job, "input").split(", "):
                again = rule.repeated and _round(path) not in ("", _round(_listed(job, "output")))
                _add(rule.before if again else rule.inputs, {_artifact(path)} & known)
    return rules


def _listed(job: str, kind: str) -> str:
    """The paths of a job, "input" or "output", as the dry run lists them."""
    found = re.search(rf"^ +{kind}: (.*)$", job, re.MULTILINE)
    return found[1] if found else ""


def _round(path: str) -> str:
    found = re.search(r"/(round\d+)/", path)
    return found[1] if found else ""


def _artifact(path: str) -> str:
    """The name of a file within the folder of its sequence or dataset; "" for what is left out of the picture."""
    name = re.sub(r"settings/[^/]+/|round\d+/", "", path.removeprefix("results/simulated/").removeprefix("demo/"))
    name = name.replace("decoded/demo/demo", "decoded/<sequence>").replace("demo.json", "<sequence>.json")
    return "" if name.startswith(LEFT_OUT) else name if Path(name).suffix or not name else f"{name}/"


def _add(names: list[str], more: Iterable[str]) -> None:
    names += [name for name in dict.fromkeys(more) if name and name not in names]


def _in_order(rules: dict[str, Rule]) -> list[Rule]:
    """Readers after makers, and every rule as late as its readers allow."""
    maker = {artifact: rule.name for rule in rules.values() for artifact in rule.outputs}
    makers = {rule.name: list(dict.fromkeys(maker[artifact] for artifact in rule.inputs)) for rule in rules.values()}
    distance = dict.fromkeys(rules, 0)
    for _ in rules:  # as often as the longest path may have steps
        for name, before in makers.items():
            for other in before:
                distance[other] = max(distance[other], distance[name] + 1)
    return sorted(rules.values(), key=lambda rule: (-distance[rule.name], rule.name))
