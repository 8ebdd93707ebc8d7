"""What the report tells of a camera that only rotates and of one that hardly moves, as the adjustment solves them."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import finished_run as run
import numpy as np
import pytest
from conftest import REPO, write_frames
from synthetic import flow_arrays, make_scene
from test_report import CHROMIUM

from stages.ba import __main__ as ba_stage
from stages.ba.options import BAOptions
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.report import __main__ as report_stage
from stages.report.options import ReportOptions
from stages.shared import sintel
from stages.shared.artifacts import write_dense

PROBE = """<script>
addEventListener("load", () => {
  document.querySelectorAll("details").forEach((part) => { part.open = true; });
  const table = (id) => document.querySelector(`[id="${id}"] + .scroll table`);
  const words = (cells) => [...cells].map((cell) => cell.firstChild ? cell.firstChild.textContent.trim() : "");
  const found = {};
  for (const id of ["poses", "adjustment", "statistics_pan", "statistics_sleeping"]) {
    const box = table(id).closest(".scroll");
    found[id] = {head: words(table(id).tHead.rows[0].cells), rows: [...table(id).tBodies[0].rows].map(
      (row) => words(row.cells)), height: box.clientHeight, clipped: box.scrollWidth - box.clientWidth};
  }
  document.body.dataset.found = JSON.stringify(found);
});
</script></body>"""


def reconstruct(root: Path, name: str, motion: str) -> Path:
    """Exact flow of a room, adjusted by the program; all else is that of another finished run of the same size."""
    scene, folder = make_scene(run.T, (run.H, run.W), motion), root / "results" / name
    frames = write_frames(root / "training/final" / name, run.T, (run.H, run.W))
    cameras = root / "training/camdata_left" / name
    cameras.mkdir(parents=True)
    for k, pose in enumerate(scene.cam_from_world, start=1):
        sintel.write_cam(cameras / f"frame_{k:04d}.cam", scene.K, pose[:3])
    inspect_stage.main(frames, folder / "sequence.json", folder / "figures/inspect.png", PartOptions())
    run.write_results(folder)
    source, target, flow, confidence = flow_arrays(scene)
    columns = {"source": source, "target": target, "flow": flow.astype(np.float16), "confidence": confidence}
    write_dense(folder / "flow/pairs.arrow", columns, {"width": run.W, "height": run.H, "scale": 1.0, "source": "dis"})
    names = {"poses": "poses.parquet", "trajectory": "trajectory.tum", "depth": "depth.arrow"}
    names |= {"convergence": "convergence.parquet", "figure": "ba.png"}
    outputs = {key: folder / "ba" / file for key, file in names.items()}
    options = BAOptions(stride_px=4, depth_stride_px=4)
    ba_stage.main(folder / "sequence.json", folder / "flow/pairs.arrow", **outputs, options=options)
    shutil.copytree(folder / "ba", folder / "round1/ba", dirs_exist_ok=True)
    run.score(folder)
    for only_drawn in ("eval/trajectory", "eval/frames", "ba/convergence", "gaussians/convergence"):
        (folder / f"{only_drawn}.parquet").unlink()
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on both cameras."""
    root = tmp_path_factory.mktemp("cameras")
    folders = [reconstruct(root, "pan", "rotate"), reconstruct(root, "sleeping", "still")]
    published = REPO / "workflow/resources/published.yaml"
    report_stage.main(folders, published, root / "index.html", root / "tables", ReportOptions())
    return root


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium found to look at the page with")
def test_the_page_says_what_the_camera_was_taken_for_and_on_which_numbers(results: Path) -> None:
    page = (results / "index.html").read_text().replace("</body>", PROBE)
    (results / "probed.html").write_text(page)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--window-size=1280,1000"]
    command = [str(CHROMIUM), *flags, "--dump-dom", str(results / "probed.html")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    match = re.search(r'<body data-found="([^"]*)"', done.stdout)
    assert match
    found = json.loads(html.unescape(match[1]))
    assert all(table["height"] > 0 and table["clipped"] <= 0 for table in found.values())
    pan, sleeping = (dict(zip(found["adjustment"]["head"], row, strict=True)) for row in found["adjustment"]["rows"])
    assert (pan["sequence"], pan["camera"], pan["focal length"]) == ("pan", "rotation-only", "estimated")
    assert (sleeping["camera"], sleeping["focal length"]) == ("near-still", "held at prior")
    assert pan["why it was held"] == ""
    assert sleeping["why it was held"] == "the camera hardly moves, and there are no masks"
    assert all(float(row["predicted focal error"]) > 0 for row in (pan, sleeping))
    assert (pan["warnings"], sleeping["warnings"]) == ("0", "2")
    assert "camera path weakly observed" in sleeping["warnings in words"]
    for name in ("pan", "sleeping"):
        values = {row[0]: float(row[1]) for row in found[f"statistics_{name}"]["rows"]}
        assert values["residual of a rotation, long baseline"] < 0.5
        assert values["static area"] == 100
        assert ("roughness of the camera path" in values) == (name == "sleeping")  # a turning camera has no path
        assert all(row[3].endswith(".") for row in found[f"statistics_{name}"]["rows"])
