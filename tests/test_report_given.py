"""What was not estimated, be it ground truth or handed in, stands on the first screen and on every table."""

import re
from pathlib import Path

import finished_run as run
import pyarrow.parquet as pq
from test_report import PUBLISHED

from stages.report import __main__ as report_stage
from stages.report.options import ReportOptions
from stages.shared.artifacts import read_metadata, write_json
from stages.shared.cameras import read_cameras, write_cameras
from stages.shared.images import write_image
from stages.shared.run_inputs import read_run_inputs


def test_inputs_from_ground_truth_stand_on_the_first_screen_and_on_every_table(tmp_path: Path) -> None:
    folder = run.finish(tmp_path)
    metadata = read_metadata(folder / "ba/poses.parquet")
    about = metadata | {"options": metadata["options"] | {"intrinsics": "truth"}}
    write_cameras(folder / "ba/poses.parquet", read_cameras(folder / "ba/poses.parquet"), about)
    write_json(folder / "masks/masks.json", {"options": {"source": "truth"}})
    run.score(folder)
    report_stage.main([folder], PUBLISHED, tmp_path / "index.html", tmp_path / "tables", ReportOptions())
    page = (tmp_path / "index.html").read_text()
    taken = "true masks, true intrinsics"
    assert f"Not estimated: {taken}." in page.partition("</header>")[0]
    titles = re.findall(r'<h3 id="(\w+)">([^<]*)', page)
    ours = {name for name, title in titles if f"(not estimated: {taken})" in title}
    assert {"poses", "images", "masks", "checks", "adjustment", "decisions"} <= ours
    poses = pq.read_table(tmp_path / "tables/poses.parquet").to_pylist()
    assert {row["method"]: row["taken"] for row in poses}["ours"] == taken
    assert {row["method"]: row["taken"] for row in poses}["COLMAP global"] is None
    masks = pq.read_table(tmp_path / "tables/masks.parquet").to_pylist()
    assert {row["method"] for row in masks} == {"motion prior", "true motion masks"}


def test_what_the_user_handed_in_stands_on_the_first_screen_and_marks_the_tables(tmp_path: Path) -> None:
    folder = run.finish(tmp_path)
    write_json(folder / "masks/masks.json", {"options": {"source": "/data/{sequence}/masks"}, "given": "instances"})
    metadata = read_metadata(folder / "ba/poses.parquet")
    about = metadata | {"options": metadata["options"] | {"depth_from": "/data/depth"}, "given_depth": "scale 3"}
    write_image(folder / "figures/motion.png", run.picture(0))
    write_cameras(folder / "ba/poses.parquet", read_cameras(folder / "ba/poses.parquet"), about)
    run.score(folder)
    files = folder / "flow/pairs.arrow", [folder / "masks"], [folder / "ba/poses.parquet"] * 3
    assert read_run_inputs(*files).masked_from == 1  # made once, before all rounds
    files[0].unlink()  # it need not be kept: `keep_flow`
    report_stage.main([folder], PUBLISHED, tmp_path / "index.html", tmp_path / "tables", ReportOptions())
    page = (tmp_path / "index.html").read_text()
    first = page.partition("</header>")[0]
    assert f"Given: masks (/data/{folder.name}/masks: instances), depth (/data/depth: scale 3)" in first
    assert "Not estimated: given masks, given depth." in first
    assert "(not estimated: given masks, given depth)" in page
    assert "Motion prior: how likely" not in page  # its picture is of an earlier run
    masks = pq.read_table(tmp_path / "tables/masks.parquet").to_pylist()
    assert {row["method"] for row in masks} == {"motion prior", "given masks"}
