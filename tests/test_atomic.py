"""Writes that fail or are killed: a file or folder is there whole, or as it was."""

import errno
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO

from stages.shared import artifacts, atomic
from stages.shared.errors import InputError


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    artifacts.write_json(path, {"value": 1})

    def write_half() -> None:
        with atomic.atomic(path) as partial:
            partial.write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_half()
    assert artifacts.read_json(path)["value"] == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_model_that_finds_no_room_fails_like_any_other_file(tmp_path: Path) -> None:
    """The command line tells an OSError by its number; safetensors has it in the text of an error of its own."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(OSError, match="too large") as failed:
            artifacts.write_model(tmp_path / "model.safetensors", {"means": np.zeros(2000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert failed.value.errno == errno.EFBIG
    assert list(tmp_path.iterdir()) == []


def test_a_killed_write_leaves_no_final_name(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from stages.shared.atomic import atomic_folder\n"
        "with atomic_folder(Path(sys.argv[1]), ['one']) as partial:\n"
        "    (partial / 'one').write_text('1'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path / "masks")], cwd=REPO, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "masks").exists()
    with atomic.atomic_folder(tmp_path / "masks", ["two"]) as partial:
        (partial / "two").write_text("2")
    assert [path.name for path in tmp_path.rglob("*")] == ["masks", "two"]


def replace_renders(folder: Path) -> None:
    """Write one image into a fresh `folder`, as the script that renders does."""
    with atomic.atomic_folder(folder, ["test/frame_*.png"]) as partial:
        (partial / "test").mkdir()
        (partial / "test" / "frame_0002.png").write_text("new")


@pytest.mark.parametrize("precious", ["notes.txt", "frame_0001.png", "test/notes.txt", "test/frame_0001.png/notes.txt"])
def test_a_folder_with_anything_else_in_it_is_never_replaced(tmp_path: Path, precious: str) -> None:
    file = tmp_path / "desktop" / precious
    file.parent.mkdir(parents=True)
    file.write_text("precious")
    with pytest.raises(InputError, match=r"desktop: expected a folder that is new.*found '.*' in it; choose another"):
        replace_renders(tmp_path / "desktop")
    assert file.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [tmp_path / "desktop"]


def test_a_folder_of_earlier_output_is_replaced_as_a_whole(tmp_path: Path) -> None:
    (tmp_path / "renders" / "test").mkdir(parents=True)
    for name in ("test/frame_0001.png", ".snakemake_timestamp"):
        (tmp_path / "renders" / name).write_text("old")
    replace_renders(tmp_path / "renders")
    assert [path.name for path in tmp_path.rglob("*")] == ["renders", "test", "frame_0002.png"]


def test_a_kill_while_the_old_folder_is_deleted_leaves_the_new_one_whole(tmp_path: Path) -> None:
    replace_renders(tmp_path / "renders")
    code = (
        "import os, shutil, signal, sys; from pathlib import Path; from stages.shared import atomic\n"
        "shutil.rmtree = lambda path: os.kill(os.getpid(), signal.SIGKILL)\n"
        "with atomic.atomic_folder(Path(sys.argv[1]), ['test/*']) as partial:\n"
        "    [(partial / name).write_text('new') for name in 'ab']"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "renders")], cwd=REPO, check=False)
    assert sorted(path.name for path in (tmp_path / "renders").iterdir()) == ["a", "b"]
    with atomic.atomic_folder(tmp_path / "renders", ["a", "b"]):
        pass
    assert list(tmp_path.iterdir()) == [tmp_path / "renders"]  # the next write clears up what the kill left


def test_no_file_takes_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "desktop").mkdir()
    (tmp_path / "desktop" / "notes.txt").write_text("precious")
    with pytest.raises(InputError, match="desktop: expected a file to write, found a folder"):
        artifacts.write_json(tmp_path / "desktop", {})
    with pytest.raises(InputError, match=r"notes.txt: expected a folder to write, found a file"):
        replace_renders(tmp_path / "desktop" / "notes.txt")
    assert (tmp_path / "desktop" / "notes.txt").read_text() == "precious"
