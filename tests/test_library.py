"""The whole scene library at preset `fast` in one run: every scene keeps its floors, and known failures say so."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import scene_page
import yaml
from conftest import REPO

from stages.results.scorecard import score_rows
from stages.shared.artifacts import read_metadata, read_model
from stages.shared.cameras import read_cameras
from stages.splatting.model_files import scene_from_tensors

SCENES = REPO / "stages/simulate/scenes"
OPTIONS: dict[str, Any] = {
    "scenes": "all",
    "preset": "fast",
    # The baseline is no part of this: it is given no time.
    "colmap": {"mappers": ["global"], "upsample": [1], "upsample_masked": [], "time_limit_s": 1},
}


@dataclass(frozen=True)
class Floor:
    """What a scene must reach: the camera error at most, in % of the path or in degrees, the rest at least."""

    ate_percent: float = 1.0
    rotation_deg: float = 0.05
    iou: float = 0.5
    psnr_db: float = 20.0
    static_db: float = 20.0
    moving_db: float = 12.0


FLOORS = {
    "balloon_field": Floor(ate_percent=0.17, iou=0.7, moving_db=29.6, psnr_db=32.2, static_db=33.3),
    "breathing_wall": Floor(ate_percent=1.7, iou=0.89, moving_db=36.7, psnr_db=36.8, static_db=36.4),
    "crowd_thin": Floor(rotation_deg=0.013, iou=0.52, moving_db=18.2, psnr_db=23.5, static_db=25.4),
    "demo": Floor(ate_percent=0.069, iou=0.81, moving_db=24.0, psnr_db=31.5, static_db=33.1),
    "dolly_walker": Floor(rotation_deg=0.0057, iou=0.87, moving_db=28.4, psnr_db=32.5, static_db=32.8),
    "evening_quay": Floor(ate_percent=0.078, iou=0.71, moving_db=22.7, psnr_db=25.5, static_db=25.8),
    "exposure_drift": Floor(ate_percent=0.15, iou=0.9, moving_db=28.7, psnr_db=31.5, static_db=32.1),
    "fast_chase": Floor(ate_percent=0.049, iou=0.83, moving_db=20.7, psnr_db=29.4, static_db=33.8),
    "festival_crowd": Floor(ate_percent=0.36, iou=0.75, moving_db=21.1, psnr_db=23.7, static_db=26.0),
    "fog_harbour": Floor(ate_percent=0.21, iou=0.71, moving_db=31.7, psnr_db=36.2, static_db=37.1),
    "fog_stones": Floor(ate_percent=0.18, iou=0.77, moving_db=33.1, psnr_db=38.7, static_db=39.0),
    "following_van": Floor(ate_percent=0.034, iou=0.84, moving_db=32.1, psnr_db=32.2, static_db=32.2),
    "foyer_glide": Floor(ate_percent=0.087, iou=0.78, moving_db=24.2, psnr_db=30.9, static_db=31.9),
    "glossy_zoom": Floor(rotation_deg=0.093, iou=0.9, moving_db=22.3, psnr_db=30.4, static_db=37.0),
    "heron_fence": Floor(ate_percent=0.082, iou=0.69, moving_db=21.5, psnr_db=23.3, static_db=23.3),
    "lamplit_library": Floor(ate_percent=0.17, iou=0.7, moving_db=30.8, psnr_db=31.3, static_db=31.4),
    "large_object": Floor(ate_percent=0.21, iou=0.9, moving_db=30.4, psnr_db=32.2, static_db=35.0),
    "long_shadows": Floor(ate_percent=0.084, iou=0.58, moving_db=20.4, psnr_db=25.2, static_db=25.8),
    "long_take": Floor(ate_percent=0.054, iou=0.71, moving_db=17.8, psnr_db=28.9, static_db=31.2),
    "museum_dolly": Floor(ate_percent=0.055, iou=0.77, moving_db=25.1, psnr_db=31.4, static_db=32.0),
    "night_alley": Floor(ate_percent=0.18, iou=0.71, moving_db=21.5, psnr_db=22.4, static_db=22.4),
    "orbit_two": Floor(ate_percent=0.077, iou=0.8, moving_db=22.7, psnr_db=28.7, static_db=29.9),
    "pan_canal": Floor(rotation_deg=0.0088, iou=0.87, moving_db=25.3, psnr_db=30.4, static_db=33.3),
    "phone_yard": Floor(ate_percent=0.087, iou=0.85, moving_db=26.7, psnr_db=27.8, static_db=27.8),
    "pure_rotation": Floor(rotation_deg=0.0065, iou=0.88, moving_db=20.4, psnr_db=30.7, static_db=34.0),
    "rolling_lane": Floor(ate_percent=0.15, iou=0.86, moving_db=29.3, psnr_db=28.4, static_db=28.3),
    "rotation_static": Floor(rotation_deg=0.0099, psnr_db=34.0, static_db=34.0),
    "ruin_walk": Floor(ate_percent=0.12, psnr_db=30.4, static_db=30.4),
    "shaky_wood": Floor(ate_percent=0.087, iou=0.69, moving_db=27.9, psnr_db=27.3, static_db=27.3),
    "sledge_pan": Floor(ate_percent=0.059, iou=0.88, moving_db=31.2, psnr_db=33.6, static_db=33.8),
    "soft_body": Floor(rotation_deg=0.0049, iou=0.9, moving_db=29.0, psnr_db=31.7, static_db=32.9),
    "splitting": Floor(rotation_deg=0.0039, iou=0.9, moving_db=27.5, psnr_db=29.5, static_db=30.7),
    "static_flight": Floor(ate_percent=0.067, psnr_db=35.5, static_db=35.5),
    "toy_train": Floor(ate_percent=0.043, iou=0.47, moving_db=21.2, psnr_db=29.6, static_db=30.6),
    "wide_playground": Floor(ate_percent=0.072, iou=0.88, moving_db=24.6, psnr_db=31.0, static_db=31.6),
    "zoom_nursery": Floor(ate_percent=0.082, iou=0.86, moving_db=28.1, psnr_db=29.3, static_db=29.4),
    "zoom_station": Floor(ate_percent=0.38, iou=0.79, moving_db=24.0, psnr_db=28.8, static_db=30.0),
}
"""Twice the error, IoU less 0.07, PSNR less 1 dB (moving: 1.5 dB) of what docs/results.md of cc646f5 shows."""
KNOWN = {
    "all_moving": "nothing is at rest",
    "dark_fog": "noise is nine times the texture",
    "epipolar_mover": "the mover closes along the camera's track",
    "blurred_karts": "blurred movers fill the view: the focal length is off by 17 %",
    "planar_wall": "one plane fills the view",
    "oncoming_tram": "the mover closes along the camera's track",
    "resting_fair": "the camera hardly moves: its path is weakly observed",
}
"""Scenes of which no accuracy is asked, and why: they must fail or be flagged."""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the whole library has run; a scene that stops does not stop the others."""
    folder = tmp_path_factory.mktemp("library")
    (folder / "mine.yaml").write_text(yaml.safe_dump(OPTIONS))
    where = ["-s", str(REPO / "Snakefile"), "--directory", str(folder), "--keep-going", "--cores", "all"]
    command = [sys.executable, "-m", "snakemake", "--quiet", "all", *where, "--configfile", str(folder / "mine.yaml")]
    subprocess.run(command, cwd=folder, check=False)
    return folder


@pytest.fixture(scope="module")
def rows(library: Path) -> dict[str, dict[str, Any]]:
    """What every scene of the library reached, by name."""
    found = score_rows(library / "results/simulated", scenes=SCENES, manifests=library / "simulated")
    return {row["sequence"]: row for row in found}


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(path.stem for path in SCENES.glob("*.yaml")))
def test_a_scene_keeps_its_floors(rows: dict[str, dict[str, Any]], name: str) -> None:
    row, floor = rows[name], FLOORS.get(name, Floor())
    assert not row.get("missing"), "a stage stopped: see the output"
    if name in KNOWN:
        assert row["status"] == "failed" or row["warnings"] > 0, f"neither flagged nor failed: {KNOWN[name]}"
        return
    assert row["status"] not in ("failed", "partial")
    if row["ate_percent"] is None:  # the truth defines none: a straight path, or a camera at rest
        assert row["rotation_deg"] <= floor.rotation_deg
    else:
        assert row["ate_percent"] <= floor.ate_percent
    if row["iou"] is None:  # nothing moves
        assert row["masked_percent"] < 1
    else:
        assert row["iou"] >= floor.iou
        assert row["psnr_dynamic"] >= floor.moving_db
    assert row["psnr_whole"] >= floor.psnr_db
    assert row["psnr_static"] >= floor.static_db


@pytest.mark.long
@pytest.mark.skipif(scene_page.CHROMIUM is None, reason="no Chromium found to look at the page with")
@pytest.mark.parametrize("name", ["demo", "exposure_drift", "glossy_zoom", "soft_body"])
def test_the_viewer_draws_what_the_rasteriser_draws(library: Path, tmp_path: Path, name: str) -> None:
    """A mover, light that changes, colours that change with the view, and a body that bends."""
    folder = library / "results/simulated" / name
    model = folder / "gaussians/model.safetensors"
    about, cameras = read_metadata(model), read_cameras(folder / "ba/poses.parquet")
    scene = scene_from_tensors(read_model(model), about)
    views = scene_page.views_of(scene, cameras, (about["width"], about["height"]), 10)
    page, unit = (folder / "gaussians/scene.html").read_text(), scene_page.unit_of(scene)
    pictures, _ = scene_page.open_pages(tmp_path, {name: page}, {name: views}, {name: unit})
    for view, picture in zip(views, pictures[name], strict=True):
        expected = scene_page.expected(scene, view, len(cameras.numbers))
        assert scene_page.psnr(picture, expected) > 45
