"""The disk that jobs are said to fill, against what runs have written, and a run for which there is no room."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from stages.flow.edges import most_edges
from stages.shared import disk
from stages.shared.disk import FILLS, megabytes_written
from stages.shared.errors import InputError
from stages.shared.images import reduced_size
from stages.shared.memory import NEEDS, Held

WRITTEN = [
    *[("flow", 200, (512, 218), 193.29), ("flow", 40, (512, 218), 38.95), ("motion", 200, (512, 218), 52.34)],
    *[("ba", 200, (512, 218), 5.04), ("render", 200, (512, 218), 88.67), ("simulate", 40, (512, 218), 79.97)],
]
"""Stage, frames, their size, and megabytes that a job of preset fast wrote, whose flow is 320 px wide."""


@pytest.mark.parametrize(("stage", "T", "size", "megabytes"), WRITTEN)
def test_jobs_are_said_to_write_what_they_write(stage: str, T: int, size: tuple[int, int], megabytes: float) -> None:
    grid, full = math.prod(reduced_size(*size, 320)), math.prod(size)
    held = Held(edges=most_edges(T, (1, 2, 4), 1) * grid, frames=T * full, frame=full, grid=T * grid)
    most = 2.2 if stage == "render" else 1.3  # the coefficient of renders is that of the largest
    assert 0.95 <= megabytes_written(stage, held) / megabytes <= most


def test_every_stage_that_is_counted_is_one() -> None:
    assert FILLS.keys() <= NEEDS.keys()


def test_what_a_run_replaces_counts_as_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pairs.arrow").write_bytes(bytes(3_000_000))
    (tmp_path / "masks").mkdir()
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1.2e9))
    outputs = [tmp_path / "pairs.arrow", tmp_path / "masks", tmp_path / "none"]
    assert disk.told(1203, outputs) == "This run writes about 1.2 GB; 1.2 GB are free."
    with pytest.raises(InputError, match=r"room for the 1\.2 GB that this run writes, found 1\.2 GB free"):
        disk.told(1204, outputs)


def test_room_is_that_of_the_disk_to_which_a_folder_of_results_leads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Path("/dev/shm")
    if not other.is_dir() or other.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no second disk")
    monkeypatch.chdir(tmp_path)
    Path("results").symlink_to(other)
    free = {tmp_path.stat().st_dev: 9e9, other.stat().st_dev: 2e6}
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=free[path.stat().st_dev]))
    results = ["results/clip/none/ba/poses.parquet", "results/clip/none/masks"]
    assert disk.told(3, ["decoded/clip"]) == "This run writes about 3 MB; 9.0 GB are free."
    with pytest.raises(InputError, match=r"room for the 3 MB that this run writes, found 2 MB free"):
        disk.told(3, ["decoded/clip", *results])
