"""Given masks in the workflow: made once, before all poses and without motion; what their time counts towards."""

import re
from pathlib import Path

from conftest import run_snakemake
from PIL import Image
from test_given_masks import labels, write
from test_workflow import planned

from stages.configuration import plan, settings
from stages.evaluate import costs
from stages.shared.artifacts import write_json


def test_masks_that_are_not_estimated_are_made_once_and_before_all_poses() -> None:
    runs = {"a": {"given": {"segment.source": "/masks"}, "other": {"segment.source": "/masks", "ba.stride_px": 4}}}
    (given, other), _ = settings.compared({"sweep": {"runs": runs, "presets": [], "knobs": {}}})
    every = [settings.configured({}), given, other]
    assert list(plan.rounds_of(given, "motion")) == []
    assert list(plan.rounds_of(given, "segment")) == [4]
    assert plan.steps(given, "scene")[1:6] == (("flow", 4), ("lens", 4), ("segment", 4), ("ba", 1), ("ba", 2))
    assert (
        plan.find_home(every, given, "segment", 1) == plan.find_home(every, other, "segment", 4) == "settings/a-given/"
    )
    assert plan.find_home(every, other, "flow", 4) == ""
    assert [plan.round_to_read(given, "segment", number) for number in (0, 1, 3)] == [None, 4, 4]
    assert [plan.round_to_read(every[0], "segment", number) for number in (0, 1, 3)] == [None, 1, 3]
    assert plan.round_to_read(given, "motion", 2) is None


def test_time_of_masks_that_were_made_once(tmp_path: Path) -> None:
    """Their seconds count towards the poses of every round."""
    spent = {"threads": 1, "wall_s": 1.0, "cpu_s": 1.0, "peak_mb": 1, "gpu_peak_mb": None, "output_mb": 1}
    files = [tmp_path / str(k) / f"{name}.json" for k, name in enumerate(("flow", "ba", "ba", "segment"))]
    for path in files:
        write_json(path, spent)
    rows = costs.time_rows("clip", files)
    assert [(row["stage"], row["round"]) for row in rows] == [("flow", None), ("segment", None), ("ba", 1), ("ba", 2)]
    assert costs.spent_to_poses(rows, 2) == [(3.0, 3.0, 1), (4.0, 4.0, 1)]


def test_given_masks_leave_out_motion_and_wait_for_nothing(repo_copy: Path) -> None:
    folder = write(repo_copy / "masks", [Image.fromarray(labels()[0]) for _ in range(14)])
    plan = run_snakemake(repo_copy, "-n", "--config", f"segment={{source: {folder}}}")
    assert "motion" not in planned(plan)
    assert (plan.stdout + plan.stderr).count("rule segment:") == 1
    assert (plan.stdout + plan.stderr).count("rule ba:") == 4
    job = next(part for part in re.split(r"\n\n", plan.stdout + plan.stderr) if "rule segment:" in part)
    assert re.search(r"input: results/simulated/demo/sequence.json$", job, re.MULTILINE)  # no flow
    (folder / "frame_0014.png").unlink()
    plan = run_snakemake(repo_copy, "-n", "--config", f"segment={{source: {folder}}}")
    assert plan.returncode == 2
    assert "expected masks for every frame, found 13 of 14, and none for 'frame_0014.png'" in plan.stderr
