"""Flow that is not kept is removed after its last reader, and nothing runs again because of it."""

import re
from pathlib import Path

from conftest import REPO, run_snakemake, write_frames

STAND_IN = """
import sys
from pathlib import Path

for path in map(Path, sys.argv):
    if path.parts[0] == "results" and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}") if path.suffix else path.mkdir()
reads = [Path(word) for word in sys.argv[1:] if word.endswith("lens/pairs.arrow")]
assert all(path.exists() for path in reads)
"""
"""A stage that makes all of its outputs, empty."""

AXES = {
    "frames": {"inspect.max_frames": []},
    "pixels": {"flow.max_side_px": [512]},
    "gaussians": {"gaussians.stride_px": []},
    "control points": {"control.control_points": []},
}
"""The growth with the pixels of the flow, of the configured run alone."""


def with_stand_ins(folder: Path) -> tuple[str, ...]:
    """Put them in place of the stages, and return the options of a run without flow that is kept, on one clip."""
    for script in (folder / "stages").glob("*/__main__.py"):
        script.write_text(STAND_IN)
    write_frames(folder / "data" / "clip")
    (folder / "mine.yaml").write_text("dataset: data\nkeep_flow: no\nrounds: 1\n")
    return "--configfile", "mine.yaml"


def planned(folder: Path, *arguments: str) -> set[str]:
    """The rules that a run would execute now."""
    plan = run_snakemake(folder, "-n", *arguments)
    assert plan.returncode == 0, plan.stderr
    return set(re.findall(r"^ *(?:local)?rule (\w+):", plan.stdout + plan.stderr, re.MULTILINE))


def test_flow_is_removed_after_its_last_reader_and_made_again_for_a_stage_that_reads_it(repo_copy: Path) -> None:
    options = with_stand_ins(repo_copy)
    run = run_snakemake(repo_copy, "--cores", "1", *options)
    assert run.returncode == 0, run.stdout + run.stderr
    results = repo_copy / "results/data"
    assert (results / "clip/eval/poses.parquet").exists()
    assert (results / "clip/stats/flow.json").exists()
    assert (results / "report/index.html").exists()
    assert not list(results.rglob("pairs.arrow"))
    assert planned(repo_copy, *options) == set()
    again = planned(repo_copy, "-R", "segment", *options)
    assert {"flow", "lens", "segment", "evaluate"} <= again
    assert "inspect" not in again
    (repo_copy / "growth.yaml").write_text("scaling: {axes: " + str(AXES) + "}")
    assert planned(repo_copy, "scaling", *options, "growth.yaml") == {
        "list_runs",
        "collect_scaling",
        "report",
        "scaling",
    }


def test_the_second_name_of_the_flow_is_the_first_output_of_its_rule() -> None:
    """Snakemake touches outputs one by one, which makes the flow newer; it must not get newer than a further output."""
    rule = (REPO / "workflow/rules/lens.smk").read_text()
    outputs = re.findall(r"^        (\w+)=", rule[rule.index("output:") : rule.index("log:")], re.MULTILINE)
    assert outputs[0] == "pairs"
