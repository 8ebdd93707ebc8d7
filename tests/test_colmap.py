"""The baseline: right on an easy scene, and failures that stay in the table."""

import shutil
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import write_frames

from stages.colmap import __main__ as colmap_stage
from stages.colmap import baseline
from stages.colmap.options import ColmapOptions
from stages.evaluate import trajectory
from stages.evaluate.ground_truth import true_cameras
from stages.evaluate.score_poses import colmap_candidates
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared.artifacts import read_metadata, read_table, write_json
from stages.shared.cameras import centred_intrinsics
from stages.shared.images import write_image
from stages.shared.sequences import read_sequence

BOTH = ("global", "incremental")


def _inspect(frames: Path, folder: Path) -> Path:
    inspect_stage.main(frames, folder / "sequence.json", folder / "inspect.png", PartOptions())
    return folder / "sequence.json"


@pytest.fixture(scope="module")
def sequence(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames of a sequence without moving parts, with their cameras."""
    folder = tmp_path_factory.mktemp("mountain")
    for kind in ("final", "camdata_left"):
        target = folder / "training" / kind / "mountain"
        target.mkdir(parents=True)
        for path in sorted((rendered / "training" / kind / "mountain_static").iterdir())[:10]:
            shutil.copy2(path, target)
    return _inspect(folder / "training" / "final" / "mountain", folder)


def test_both_mappers_find_the_cameras_and_repeat_themselves(sequence: Path, tmp_path: Path) -> None:
    options = ColmapOptions(window=5, mappers=BOTH)
    first, second = tmp_path / "first.parquet", tmp_path / "second.parquet"
    colmap_stage.main(sequence, first, options)
    frames = read_sequence(sequence)
    truth = true_cameras(frames)
    assert truth is not None
    for candidate in colmap_candidates(first):
        assert candidate.failure is None
        assert candidate.cameras is not None
        assert len(candidate.cameras.numbers) == candidate.total == len(frames.frames)
        assert candidate.wall_s is None  # it gives way to other work: only its CPU time says something
        assert candidate.cpu_s > 0
        errors = trajectory.pose_errors(candidate.cameras.cam_from_world, truth.cam_from_world, truth.numbers)
        assert errors.ate_percent < 1
        assert abs(trajectory.focal_error_percent(candidate.cameras.Ks, truth.Ks)) < 10
    colmap_stage.main(sequence, second, options.model_copy(update={"mappers": ("global",)}))
    kept = read_table(first)["method"] == "COLMAP global"
    for name, column in read_table(second).items():
        np.testing.assert_array_equal(read_table(first)[name][kept], column)


def test_enlarged_frames_give_intrinsics_of_the_original_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera with f = 200 and its principal point at the centre of 160 x 120 has f = 100 at 80 x 60."""
    seen = []

    def stand_in(step: Callable, arguments: tuple, _seconds: float) -> Any:
        if step is not baseline.reconstruct:
            return None
        seen.append(cv2.imread(str(arguments[0] / "frame_0001.png")).shape)
        return np.tile(np.eye(4), (1, 1, 1)), centred_intrinsics(200, 160, 120)[None], ["frame_0001.png"]

    monkeypatch.setattr(colmap_stage, "run_limited", stand_in)
    sequence = _inspect(write_frames(tmp_path / "clip", size=(60, 80)), tmp_path)
    colmap_stage.main(sequence, tmp_path / "poses.parquet", ColmapOptions(mappers=("global",), upsample=(2,)))
    (candidate,) = colmap_candidates(tmp_path / "poses.parquet")
    assert seen == [(120, 160, 3)]
    assert candidate.method == "COLMAP global, x2"
    assert candidate.cameras is not None
    np.testing.assert_allclose(candidate.cameras.Ks[0], centred_intrinsics(100, 80, 60), atol=1e-12)


def test_masked_variants_have_no_features_on_dynamic_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The left half is dynamic: COLMAP's own database must hold no point there, at both sizes."""
    seen: dict[int, np.ndarray] = {}

    def spy(step: Callable, arguments: tuple, _seconds: float) -> Any:
        step(*arguments)
        with sqlite3.connect(arguments[2]) as database:
            (shape,) = set(database.execute("select cols from keypoints"))
            points = [np.frombuffer(row[0], np.float32) for row in database.execute("select data from keypoints")]
        seen[len(seen) + 1] = np.concatenate(points).reshape(-1, shape[0])[:, 0]
        raise baseline.StepFailed("enough seen")

    monkeypatch.setattr(colmap_stage, "run_limited", spy)
    noise = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8), (0, 0), 1.5)
    for number in range(1, 4):
        write_image(tmp_path / f"clip/frame_{number:04d}.png", noise)
        write_image(tmp_path / f"masks/frame_{number:04d}.png", np.arange(160) < np.full((120, 1), 80))
    write_json(tmp_path / "masks/masks.json", {"options": {"source": "refined"}})
    sequence, output = _inspect(tmp_path / "clip", tmp_path), tmp_path / "poses.parquet"
    colmap_stage.main(
        sequence, output, ColmapOptions(window=1, mappers=BOTH, upsample_masked=(1, 2)), masks=tmp_path / "masks"
    )
    assert all(len(seen[factor]) > 30 for factor in (1, 2))
    assert all(seen[factor].min() >= 80 * factor - 1 for factor in (1, 2))
    methods = [candidate.method for candidate in colmap_candidates(output)]
    assert methods[0] == "COLMAP global, with our refined masks"
    assert methods[-1] == "COLMAP incremental, x2, with our refined masks"
    colmap_stage.main(sequence, output, ColmapOptions(window=1))
    assert seen[3].min() < 70
    write_json(tmp_path / "masks/masks.json", {"options": {"source": "truth"}})
    colmap_stage.main(sequence, output, ColmapOptions(window=1, upsample_masked=(1,)), masks=tmp_path / "masks")
    true = colmap_candidates(output)[0]
    assert (true.method, true.taken, true.threads) == ("COLMAP global, with true motion masks", "true masks", 1)


def test_frames_without_texture_are_a_failed_row_with_a_reason(tmp_path: Path) -> None:
    frames = tmp_path / "grey"
    frames.mkdir()
    for number in range(1, 5):
        cv2.imwrite(str(frames / f"frame_{number:04d}.png"), np.full((60, 80, 3), 128, np.uint8))
    output = tmp_path / "poses.parquet"
    colmap_stage.main(_inspect(frames, tmp_path), output, ColmapOptions(mappers=BOTH))
    outcomes = read_metadata(output)["variants"]
    assert [outcome["method"] for outcome in outcomes] == ["COLMAP global", "COLMAP incremental"]
    assert all(outcome["registered"] == 0 and outcome["failure"] for outcome in outcomes)
    assert all(candidate.cameras is None for candidate in colmap_candidates(output))


def test_a_variant_that_hangs_is_stopped(sequence: Path, tmp_path: Path) -> None:
    output = tmp_path / "poses.parquet"
    colmap_stage.main(sequence, output, ColmapOptions(time_limit_s=1, mappers=BOTH))
    for outcome in read_metadata(output)["variants"]:
        assert "stopped after 1 s of CPU" in outcome["failure"]
    assert not list(tmp_path.glob(".colmap-*"))


def test_a_step_that_raises_or_crashes_gives_its_reason() -> None:
    with pytest.raises(baseline.StepFailed, match="ValueError: no"):
        baseline.run_limited(_raise, ("no",), 30)
    with pytest.raises(baseline.StepFailed, match="exit code 7"):
        baseline.run_limited(_exit, (7,), 30)
    start = time.perf_counter()
    with pytest.raises(baseline.StepFailed, match="stopped after 1 s of CPU"):
        baseline.run_limited(_spin, (60,), 1.0)
    with pytest.raises(baseline.StepFailed, match="stopped after 2 s"):
        baseline.run_limited(time.sleep, (60,), 1.0, patience=2.0)
    assert time.perf_counter() - start < 30
    assert baseline.run_limited(_add, (2, 3), 30) == 5


def _raise(message: str) -> None:
    raise ValueError(message)


def _spin(seconds: float) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def _exit(code: int) -> None:
    import os

    os._exit(code)


def _add(a: int, b: int) -> int:
    return a + b
