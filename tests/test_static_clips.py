"""Clips in which nothing moves, under every kind of noise, fog and blur of the library: nothing is called moving."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPO

from stages.shared.artifacts import read_json

SCENES = REPO / "stages/simulate/scenes"
STILL = ("planar_wall", "rotation_static", "static_flight")
DISTURBED = ("dark_fog", "night_alley", "fog_harbour", "blurred_karts", "exposure_drift")
"""Scenes with the strongest noise, fog, motion blur and exposure change of the library."""
EFFECTS = ("fog", "noise", "motion_blur", "exposure")
"""Not the vignette: it stays put in the picture, and where nothing but fog is behind it, it moves against the world."""
FRAMES = 16
MOST = 1e-3
"""Share of the pixels that may be called moving."""


def described(name: str) -> dict[str, Any]:
    """A scene of the library as its file says."""
    return dict(yaml.safe_load((SCENES / f"{name}.yaml").read_text()))


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the masks of all clips, by `<still scene>_in_<disturbed scene>`."""
    folder = tmp_path_factory.mktemp("static")
    scenes = []
    for still in STILL:
        for disturbed in DISTURBED:
            effects = {name: value for name, value in described(disturbed)["effects"].items() if name in EFFECTS}
            path = folder / f"{still}_in_{disturbed}.yaml"
            path.write_text(yaml.safe_dump(described(still) | {"frames": FRAMES, "effects": effects}))
            scenes.append(str(path))
    (folder / "mine.yaml").write_text(yaml.safe_dump({"scenes": scenes, "preset": "fast"}))
    where = ["-s", str(REPO / "Snakefile"), "--directory", str(folder), "--keep-going", "--cores", "all"]
    command = [sys.executable, "-m", "snakemake", "--quiet", "all", *where, "masks"]
    subprocess.run([*command, "--configfile", str(folder / "mine.yaml")], cwd=folder, check=True)
    return folder / "results/simulated"


@pytest.mark.long
@pytest.mark.parametrize("disturbed", DISTURBED)
@pytest.mark.parametrize("still", STILL)
def test_nothing_is_called_moving(clips: Path, still: str, disturbed: str) -> None:
    shares = read_json(clips / f"{still}_in_{disturbed}/masks/masks.json")["dynamic_share"]
    assert len(shares) == FRAMES
    assert sum(shares.values()) / FRAMES < MOST
