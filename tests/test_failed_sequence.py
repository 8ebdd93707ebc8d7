"""A clip without texture goes through every stage and ends as a row that says failed, beside a good sequence."""

from pathlib import Path
from typing import Any

import cv2
import finished_run
import numpy as np
import pytest
from conftest import REPO

from stages.ba import __main__ as ba_stage
from stages.ba.options import BAOptions
from stages.colmap import __main__ as colmap_stage
from stages.colmap.options import ColmapOptions
from stages.control import __main__ as control_stage
from stages.control.options import ControlOptions
from stages.evaluate import __main__ as evaluate_stage
from stages.evaluate.options import EvaluateOptions
from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.gaussians import __main__ as gaussians_stage
from stages.gaussians.options import GaussiansOptions
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.motion import __main__ as motion_stage
from stages.motion.options import MotionOptions
from stages.render import __main__ as render_stage
from stages.render.options import RenderOptions
from stages.report import __main__ as report_stage
from stages.report.options import ReportOptions
from stages.scene import __main__ as scene_stage
from stages.scene.options import SceneOptions
from stages.segment import __main__ as segment_stage
from stages.segment.options import SegmentOptions
from stages.shared.artifacts import read_metadata, read_table

FLOW, PRIOR, POSES, DEPTH = "flow/pairs.arrow", "motion/prior.arrow", "ba/poses.parquet", "ba/depth.arrow"
POINTS, MOTION = "control/points.parquet", "control/deformation.safetensors"
MODEL, HALF = "gaussians/model.safetensors", "gaussians/model_half.safetensors"


def reconstruct(frames: Path, folder: Path) -> None:
    """Every stage in one round, as the workflow calls them, with hardly any training."""

    def at(**names: str) -> dict[str, Any]:
        return {name: folder / path for name, path in names.items()}

    inspect_stage.main(frames, **at(output="sequence.json", figure="figures/inspect.png"), options=PartOptions())
    frames_and = at(sequence="sequence.json", flow=FLOW)
    flow_stage.main(**at(sequence="sequence.json", output=FLOW, figure="figures/flow.png"), options=FlowOptions())
    motion_stage.main(**frames_and, **at(output=PRIOR, figure="figures/motion.png"), options=MotionOptions())
    segment_stage.main(
        **frames_and, **at(prior=PRIOR, output="masks", figure="figures/segment.png"), options=SegmentOptions()
    )
    solved = at(trajectory="ba/trajectory.tum", convergence="ba/convergence.parquet", figure="figures/ba.png")
    ba_stage.main(**frames_and, **at(masks="masks", poses=POSES, depth=DEPTH), **solved, options=BAOptions())
    known = frames_and | at(masks="masks", poses=POSES, depth=DEPTH)
    scene_stage.main(**known, **at(output="scene.json", figure="figures/scene.png"), options=SceneOptions())
    known |= at(scene="scene.json", points=POINTS, deformation=MOTION)
    control_stage.main(**known, **at(figure="figures/control.png"), options=ControlOptions(steps=2))
    del known["flow"]
    trained = at(convergence="gaussians/convergence.parquet", figure="figures/gaussians.png", ply="gaussians/all.ply")
    gaussians_stage.main(**known, **trained, **at(model=MODEL, half=HALF), options=GaussiansOptions(steps=2))
    rendered = at(sequence="sequence.json", poses=POSES, model=MODEL, output="renders", video="figures/render.gif")
    render_stage.main(**rendered, options=RenderOptions(novel_views=2))


def score(folder: Path, stats: list[Path]) -> None:
    """The baseline and the evaluation; `stats` are the stages' time files."""
    baseline = folder / "colmap.parquet"
    colmap_stage.main(folder / "sequence.json", baseline, ColmapOptions(mappers=("global",), upsample=(1,)))
    inputs = {"flow": FLOW, "depth": DEPTH, "deformation": MOTION, "model": MODEL, "half": HALF, "renders": "renders"}
    evaluate_stage.main(
        sequence=folder / "sequence.json",
        **{name: folder / path for name, path in inputs.items()},
        **{name: [folder / path] for name, path in (("priors", PRIOR), ("masks", "masks"), ("poses", POSES))},
        colmap=[baseline],
        stage_stats=stats,
        **{f"{kind}_table": folder / f"eval/{kind}.parquet" for kind in finished_run.TABLES},
        figure=folder / "figures/trajectory.png",
        options=EvaluateOptions(),
    )


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the results of both sequences and the report."""
    root = tmp_path_factory.mktemp("failed")
    (root / "blank").mkdir()
    for number in range(1, 6):
        cv2.imwrite(str(root / f"blank/frame_{number:04d}.png"), np.full((48, 64, 3), 128, np.uint8))
    blank = root / "results/blank"
    reconstruct(root / "blank", blank)
    wall = finished_run.finish(root, "wall")
    score(blank, finished_run.stats_files(wall))
    published = REPO / "workflow/resources/published.yaml"
    report_stage.main([wall, blank], published, root / "index.html", root / "tables", ReportOptions())
    return root


def test_it_is_a_row_and_counted(reported: Path) -> None:
    rows = read_table(reported / "results/blank/eval/poses.parquet")
    assert dict(zip(rows["method"], rows["status"], strict=True)) == {"ours": "failed", "COLMAP global": "failed"}
    assert set(rows["registered"]) == {0}
    means = read_table(reported / "tables/poses_mean.parquet")
    ours = list(means["method"]).index("ours")
    assert [means[name][ours] for name in ("n", "sequences", "failed")] == [1, 2, 1]


def test_the_report_and_the_model_say_why(reported: Path) -> None:
    assert read_metadata(reported / "results/blank" / MODEL)["status"] == "poses failed"
    page = (reported / "index.html").read_text()
    assert "blank, ours: failed (neighbouring frames share too few confident static matches" in page
    assert page.count("a static scene was trained before a camera at rest") == 1
