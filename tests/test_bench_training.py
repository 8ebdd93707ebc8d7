"""The benchmark of training takes a sequence up as it was trained, and shares out all of its time."""

import re
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from gaussian_files import outputs, write_inputs

from benchmarks import bench_training
from stages.gaussians import __main__ as gaussians_stage
from stages.gaussians.options import GaussiansOptions


@pytest.fixture
def setting(tmp_path: Path) -> Path:
    """A setting of a sweep that was trained for six steps; all but its model lies in the folder of the sequence."""
    inputs, home = write_inputs(tmp_path / "files"), tmp_path / "clip"
    folder = home / "settings" / "gaussians.steps=6"
    gaussians_stage.main(**inputs, **outputs(folder / "gaussians"), options=GaussiansOptions(steps=6, stride_px=5))
    for name, path in bench_training.INPUTS.items():
        (home / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(inputs[name], home / path)
    return folder


def test_a_sequence_is_trained_as_it_was(setting: Path, tmp_path: Path) -> None:
    start = bench_training.beginning_of(setting, tmp_path)
    assert start.trainer.options == GaussiansOptions(steps=6, stride_px=5)
    text = bench_training.profile(setting, defaultdict(lambda: np.zeros(2)))
    assert " 6 steps in " in text
    assert sum(float(share) for share in re.findall(r"(\d+) % of CPU", text)) == pytest.approx(100, abs=5)


def test_what_is_missing_is_named(setting: Path, tmp_path: Path) -> None:
    (tmp_path / "clip" / "ba" / "depth.arrow").unlink()
    with pytest.raises(SystemExit, match=r"no ba/depth\.arrow: name a folder results/<dataset>/<sequence>"):
        bench_training.beginning_of(setting, tmp_path)


@pytest.mark.parametrize("folder", ["/nowhere", "nowhere", "/"])
def test_a_folder_that_holds_no_results_is_named(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=rf"^{folder}: no lens/sequence\.json: name a folder"):
        bench_training.beginning_of(Path(folder), tmp_path)
