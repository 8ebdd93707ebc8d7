"""A killed adjustment is taken up where it stood."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ba_files import outputs, write_inputs
from synthetic import flow_arrays, make_scene

from stages.ba import checkpoint, dba
from stages.ba.__main__ import main
from stages.ba.options import BAOptions
from stages.ba.solving import files_named
from stages.shared import costs
from stages.shared.artifacts import read_dense, read_table
from stages.shared.sequences import Sequence

OPTIONS = BAOptions(stride_px=4, start_focals=(0.9,), zoom="no", rolling_shutter="no")
KILLED_AT = 11
SCRIPT = f"""
import os, signal, sys
from pathlib import Path
from ba_files import outputs
from stages.ba import checkpoint, dba
from stages.ba.__main__ import main
from stages.ba.options import BAOptions

checkpoint.INTERVAL_S = -1
propose, left = dba.propose, [{KILLED_AT}]

def counted(*arguments):
    left[0] -= 1
    if left[0] < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return propose(*arguments)

dba.propose = counted
folder = Path(sys.argv[1])
files = {{"sequence": folder / "sequence.json", "flow": folder / "pairs.arrow", "masks": folder / "masks"}}
main(**files, **outputs(folder / "out"), options=BAOptions.model_validate_json(sys.argv[2]))
"""


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of proposals so far."""
    count, propose = [0], dba.propose

    def counting(*arguments: Any) -> Any:
        count[0] += 1
        return propose(*arguments)

    monkeypatch.setattr(dba, "propose", counting)
    return count


def test_a_killed_adjustment_ends_with_the_result_of_one_that_was_not(tmp_path: Path, counted: list[int]) -> None:
    scene = make_scene(T=5, size=(48, 64))
    files = write_inputs(tmp_path, flow_arrays(scene, (1, 2)), scene.dynamic)
    main(**files, **(whole := outputs(tmp_path / "whole")), options=OPTIONS)
    total, counted[0] = counted[0], 0
    assert total > KILLED_AT + 3
    assert [file.name for file in (tmp_path / "whole").iterdir() if file.is_dir()] == []

    arguments = [sys.executable, "-c", SCRIPT, str(tmp_path), OPTIONS.model_dump_json()]
    tests = Path(__file__).parent
    modules = os.pathsep.join(map(str, (tests, tests.parent)))
    killed = subprocess.run(arguments, check=False, env={**os.environ, "PYTHONPATH": modules})
    assert killed.returncode == -signal.SIGKILL
    paths = outputs(tmp_path / "out")
    folder = paths["poses"].with_name(".poses.checkpoint")
    assert folder.is_dir()
    assert not paths["poses"].exists()
    shutil.copytree(folder, tmp_path / "other" / folder.name)

    main(**files, **paths, options=OPTIONS)
    assert counted[0] == total - KILLED_AT
    assert not folder.exists()
    assert costs.spent()["taken_over_s"] > 0
    for name, values in read_table(whole["poses"]).items():  # kernels round differently when just compiled
        _assert_same(read_table(paths["poses"])[name], values)
    for name, values in read_dense(whole["depth"]).items():
        _assert_same(read_dense(paths["depth"])[name], values)

    counted[0] = 0
    main(**files, **outputs(tmp_path / "other"), options=OPTIONS.model_copy(update={"seed": 1}))
    assert counted[0] > total - KILLED_AT + 3


def _assert_same(found: np.ndarray, expected: np.ndarray) -> None:
    if expected.dtype.kind == "f":
        np.testing.assert_allclose(found, expected, rtol=1e-6 if expected.dtype == np.float32 else 1e-10, atol=1e-12)
    else:
        assert (found == expected).all()


def test_a_short_run_writes_no_checkpoint(tmp_path: Path) -> None:
    with checkpoint.kept(tmp_path / "poses.parquet", [], OPTIONS):
        assert (checkpoint.array(lambda: np.arange(3.0)) == np.arange(3.0)).all()
        assert list(tmp_path.iterdir()) == []


def test_a_failed_run_keeps_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "INTERVAL_S", -1)
    poses, work = tmp_path / "poses.parquet", [1.0, 2.0]
    with pytest.raises(ZeroDivisionError), checkpoint.kept(poses, [], OPTIONS):
        checkpoint.array(lambda: np.array(work)) / (1 // int(0 * work[0]))
    with checkpoint.kept(poses, [], OPTIONS):
        assert (checkpoint.array(lambda: np.zeros(2)) == work).all()
        assert (checkpoint.array(lambda: np.zeros(2)) == 0).all()
    assert list(tmp_path.iterdir()) == []


def test_what_a_power_cut_has_damaged_is_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "INTERVAL_S", -1)
    poses = tmp_path / "poses.parquet"

    def killed() -> None:
        with checkpoint.kept(poses, [], OPTIONS):
            for values in (np.full(9, 0), np.full(9, 1), np.full(9, 2)):
                checkpoint.array(values.copy)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        killed()
    damaged = tmp_path / ".poses.checkpoint/0001.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:40])
    with checkpoint.kept(poses, [], OPTIONS):
        assert [checkpoint.array(lambda: np.full(9, 7))[0] for _ in range(3)] == [0, 7, 2]


def test_frames_and_truth_are_of_the_origin(tmp_path: Path) -> None:
    """Texture weighs matches, and true poses take the place of estimated ones: other files are another run."""
    frame, camera = tmp_path / "frame_0001.png", tmp_path / "frame_0001.cam"
    frames = Sequence("clip", [frame], [1], 8, 8, {"camdata_left": {1: camera}})
    true_poses = OPTIONS.model_copy(update={"poses_from": "truth"})
    assert (files_named(frames, OPTIONS), files_named(frames, true_poses)) == ([frame], [frame, camera])
