"""Fixtures that several test files share."""

# First of all imports: it tells OpenMP not to spin, which is read once, when numpy or torch loads libgomp. Without it,
# tests of torch and numba take 15 times the CPU time on a busy machine.
import stages  # noqa: F401, I001

import logging
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import snakemake_run
import yaml

from stages.shared import costs
from stages.shared.log import logger

if TYPE_CHECKING:
    import torch

REPO = Path(__file__).resolve().parents[1]
DATA = REPO.parent / "shared" / "data"
SOURCES = ("Snakefile", "config.yaml", "profiles", "workflow", "stages")

TIMEOUT_S = 900.0
"""Of a run of Snakemake."""
BEGUN_FIRST = "test_workflow"
"""The file of plans takes minutes: begun last, one process would wait for it in the end. It runs no stage, so that no
kernel is compiled earlier than before."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests in the order of their files but for one (`make test` has two processes, each with whole files)."""
    items.sort(key=lambda item: item.path.stem != BEGUN_FIRST)


def run_snakemake(folder: Path, *arguments: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """`snakemake ARGUMENTS` in `folder` and in the environment `env` (None: this one), with its output as text."""
    if env is None:
        return snakemake_run.run(folder, arguments, TIMEOUT_S)
    command = [sys.executable, "-m", "snakemake", *arguments]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)


def write_scenes(folder: Path, frames: int = 8, width: int = 256, height: int = 112) -> None:
    """The demo scene, small and without effects, with and without its walker: moving.yaml and still.yaml."""
    scene = yaml.safe_load((REPO / "stages/simulate/scenes/demo.yaml").read_text())
    scene |= {"frames": frames, "width": width, "height": height, "effects": {}}
    still = [thing for thing in scene["objects"] if thing["name"] != "walker"]
    (folder / "moving.yaml").write_text(yaml.safe_dump(scene))
    (folder / "still.yaml").write_text(yaml.safe_dump(scene | {"objects": still}))


def write_frames(folder: Path, count: int = 4, size: tuple[int, int] = (48, 64), first: int = 1) -> Path:
    """A folder of `count` textured PNG frames of (height, width)."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for number in range(first, first + count):
        image = rng.integers(0, 255, (*size, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"frame_{number:04d}.png"), image)
    return folder


@pytest.fixture(autouse=True)
def _fresh_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has taken over no work of a killed run, for each test."""
    monkeypatch.setattr(costs, "_before", {})


@pytest.fixture(autouse=True)
def _fresh_log() -> Iterator[None]:
    """The log as at a program's start, after a test that ran a stage's main in this process, too.

    `log.setup` sets the level and ends the propagation to the root logger, on both of which `caplog` of every later
    test depends.
    """
    yield
    logger.setLevel(logging.NOTSET)
    logger.propagate = True
    for handler in logger.handlers[:]:
        logger.removeHandler(handler)
        handler.close()


@pytest.fixture
def cuda() -> "torch.device":
    """The first CUDA device; a test that asks for it is skipped where there is none, or no gsplat."""
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device("cuda")


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A dataset folder with one valid sequence of four small frames in `clip`."""
    write_frames(tmp_path / "data" / "clip")
    return tmp_path / "data"


def copy_sources(folder: Path) -> Path:
    """The sources of the workflow in `folder`, to edit freely, with the compiled files beside them."""
    for name in SOURCES:
        if (REPO / name).is_dir():
            unfinished = shutil.ignore_patterns("*.pyc.*")  # another process is about to rename these
            shutil.copytree(REPO / name, folder / name, ignore=unfinished, dirs_exist_ok=True)
        else:
            shutil.copy2(REPO / name, folder / name)
    return folder


@pytest.fixture
def repo_copy(tmp_path: Path) -> Path:
    """A copy of the workflow's sources."""
    return copy_sources(tmp_path)


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered sequences with exact truth, in MPI-Sintel layout."""
    if not (DATA / "unpack.py").exists():
        pytest.skip(f"no measuring data at {DATA}")
    target = tmp_path_factory.mktemp("rendered")
    subprocess.run([sys.executable, str(DATA / "unpack.py"), str(target)], check=True)
    return target
