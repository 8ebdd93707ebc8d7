"""Bad input stops before any work: exit code 2, one line that helps, no output, no traceback."""

import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import REPO, run_snakemake, write_frames

from stages.configuration import config as configuration
from stages.configuration import datasets
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared import sintel
from stages.shared.dataset_folders import sequence_folders
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence, read_sequence


def refuse(folder: Path, options: str, *phrases: str) -> None:
    """Assert that snakemake in `folder` with these options stops in one line that holds the phrases."""
    (folder / "mine.yaml").write_text(options)
    before = {path for path in folder.rglob("*") if ".snakemake" not in path.parts}
    snakefile = str(REPO / "Snakefile")
    result = run_snakemake(folder, "-s", snakefile, "--cores", "1", "--configfile", "mine.yaml")
    said = [line for line in result.stderr.splitlines() if not line.startswith(("Using workflow", "Config file"))]
    assert result.returncode == 2, result.stderr + result.stdout
    assert len(said) == 1, result.stderr
    assert all(phrase in said[0] for phrase in phrases), said[0]
    assert "Traceback" not in result.stdout + result.stderr
    assert {path for path in folder.rglob("*") if ".snakemake" not in path.parts} == before


@pytest.mark.parametrize(
    ("options", "phrases"),
    [
        ("dataset: nowhere", ("nowhere", "expected a folder", "found nothing there")),
        ("dataset: data\nsequences: [clap]", ("'clap'", "did you mean 'clip'?")),
        ("scenes: [dem]", ("'dem'", "did you mean 'demo'?")),
        ("scenes: [own.yaml]", ("own.yaml", "a scene file")),
        ("flwo: {}", ("flwo", "did you mean 'flow'?")),
        ("flow: {offsets: [2, 4]}", ("flow.offsets", "1 among the frame distances")),
        ("flow: {ofsets: [1]}", ("flow.ofsets", "did you mean 'offsets'?")),
        ("flow: {finest_scale: many}", ("flow.finest_scale", "integer", "'many'")),
        ("flow: {max_side_px: -3}", ("flow.max_side_px", "greater than or equal to 64", "-3")),
        ("flow: {finest_scale: true}", ("flow.finest_scale", "a number", "True")),
        ("holdout_every: eight", ("holdout_every", "integer", "'eight'")),
        ("pass: finale", ("pass", "'clean' or 'final'", "'finale'")),
        ("ba: 3", ("ba", "dictionary", "3")),
        (
            "dataset: data\nshots: no\ninspect: {max_frames: 3}\nholdout_every: 2\nholdout_first: 0",
            ("mine.yaml: holdout_every", "at least 2 frames to train on", "1 of 3"),
        ),
        ("dataset: data\nshots: no\nintrinsics: truth", ("mine.yaml: intrinsics", "camdata_left", "to 'estimate'")),
        ("dataset: data\nshots: no\nsegment: {source: truth}", ("segment.source", "motion_mask", "to 'refined'")),
        ("seed: 2147483648", ("seed", "less than or equal to 2147483647", "2147483648")),
    ],
)
def test_wrong_configuration(frames: Path, options: str, phrases: tuple[str, ...]) -> None:
    refuse(frames.parent, options, *phrases)


@pytest.mark.parametrize("name", ["results", "logs", "decoded", "results/data"])
def test_a_file_where_results_belong(frames: Path, name: str) -> None:
    path = frames.parent / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    refuse(frames.parent, "dataset: data", f"{name}: expected a folder, found a file; move it, or run elsewhere")


def test_a_link_to_a_disk_that_is_not_there(frames: Path) -> None:
    (frames.parent / "results").symlink_to("nowhere")
    refuse(frames.parent, "dataset: data", "results: expected a folder, found a link to nothing")


def test_folders_that_cannot_be_written_to(frames: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a file system that is mounted for reading: Snakemake ends in a traceback there."""
    monkeypatch.chdir(frames.parent)
    config = configuration.load({"dataset": "data"})
    datasets.require_folders(config)
    for name in ("results", "."):
        Path(name).mkdir(exist_ok=True)
        monkeypatch.setattr(os, "access", lambda path, _, name=name: Path(path) != Path(name))
        with pytest.raises(InputError, match="expected a folder to write to, found one that is read-only; make it"):
            datasets.require_folders(config)


def truncate(folder: Path) -> None:
    path = folder / "frame_0002.png"
    path.write_bytes(path.read_bytes()[:-40])


def remove_third(folder: Path) -> None:
    (folder / "frame_0003.png").unlink()


def resize_second(folder: Path) -> None:
    cv2.imwrite(str(folder / "frame_0002.png"), np.zeros((20, 30, 3), np.uint8))


def replace_by_text(folder: Path) -> None:
    (folder / "frame_0002.png").write_text("not an image")


def duplicate_number(folder: Path) -> None:
    shutil.copy(folder / "frame_0002.png", folder / "other_0002.png")


def unnumber(folder: Path) -> None:
    (folder / "frame_0002.png").rename(folder / "second.png")


@pytest.mark.parametrize(
    ("damage", "phrases"),
    [
        (truncate, ("frame_0002.png", "a complete image", "ends too early")),
        (remove_third, ("frame_0004.png", "frame number 3", "4 after 2")),
        (resize_second, ("frame_0002.png", "64 x 48", "30 x 20")),
        (replace_by_text, ("frame_0002.png", "PNG or JPEG")),
        (duplicate_number, ("0002.png", "the same number twice")),
        (unnumber, ("second.png", "a frame number in the name")),
    ],
)
def test_wrong_frames(frames: Path, damage: Callable[[Path], None], phrases: tuple[str, ...]) -> None:
    damage(frames / "clip")
    refuse(frames.parent, "dataset: data", *phrases)


def test_of_many_frames_and_in_jobs_the_first_header_alone_is_read(
    frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truncate(frames / "clip")
    config = configuration.load({"dataset": str(frames)})
    folders = datasets.frame_folders(config, {})
    with pytest.raises(InputError, match="ends too early"):
        datasets.find_sequences(config, folders, {})
    in_job = datasets.find_sequences(config, folders, {}, headers=False)["clip"]
    monkeypatch.setattr(datasets, "EARLY_FRAMES", 3)
    assert datasets.find_sequences(config, folders, {})["clip"] == in_job
    assert (in_job.width, in_job.height, in_job.numbers) == (64, 48, [1, 2, 3, 4])
    with pytest.raises(InputError, match="ends too early"):
        check_sequence("clip", frames / "clip")


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_frames(tmp_path: Path, count: int) -> None:
    write_frames(tmp_path / "data" / "clip", count)
    refuse(tmp_path, "dataset: data", "clip", "at least 3 frames", f"found {count}")


@pytest.mark.parametrize(("w", "h"), [(328, 40), (40, 328)])
def test_a_strip_is_refused(tmp_path: Path, w: int, h: int) -> None:
    for path in write_frames(tmp_path / "data" / "clip").iterdir():
        cv2.imwrite(str(path), np.full((h, w, 3), 99, np.uint8))
    expected = "longer side is at most 8 times the shorter one"
    refuse(tmp_path, "dataset: data", expected, f"{w} x {h}", "crop their longer side")


def test_no_frames(tmp_path: Path) -> None:
    (tmp_path / "data" / "clip").mkdir(parents=True)
    refuse(tmp_path, "dataset: data", "data", "folders of PNG or JPG frames", "found none")


def test_a_missing_pass_names_the_one_there(tmp_path: Path) -> None:
    write_frames(tmp_path / "sintel" / "training" / "clean" / "alley_1", first=16)
    refuse(tmp_path, "dataset: sintel", "the pass 'final'", "only clean", "set `pass: clean`")


def test_numbering_need_not_begin_at_one(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "alley_1", first=16)
    assert check_sequence("alley_1", folder).numbers == [16, 17, 18, 19]


def run_check(folder: Path, output: Path) -> subprocess.CompletedProcess[str]:
    """The input check from the command line."""
    flags = ["--frames", str(folder), "--output", str(output), "--figure", str(output.with_suffix(".png"))]
    command = [sys.executable, "-m", "stages.inspect", *flags]
    return subprocess.run(command, capture_output=True, text=True, cwd=REPO, check=False)


def sintel_clip(root: Path) -> Path:
    """A folder of frames in MPI-Sintel layout, with valid truth beside it."""
    folder = write_frames(root / "training" / "final" / "clip")
    for number in range(1, 5):
        name = f"frame_{number:04d}"
        for kind in ("flow", "depth", "camdata_left"):
            (root / "training" / kind / "clip").mkdir(parents=True, exist_ok=True)
        sintel.write_flo(root / "training/flow/clip" / f"{name}.flo", np.zeros((48, 64, 2)))
        sintel.write_dpt(root / "training/depth/clip" / f"{name}.dpt", np.ones((48, 64)))
        sintel.write_cam(root / "training/camdata_left/clip" / f"{name}.cam", np.eye(3), np.eye(3, 4))
    return folder


@pytest.mark.parametrize(
    "kind", ["flow/clip/frame_0002.flo", "depth/clip/frame_0002.dpt", "camdata_left/clip/frame_0002.cam"]
)
@pytest.mark.parametrize("damage", ["tag", "size", "empty"])
def test_damaged_truth(tmp_path: Path, kind: str, damage: str) -> None:
    folder = sintel_clip(tmp_path)
    assert run_check(folder, tmp_path / "out" / "fine.json").returncode == 0
    path = tmp_path / "training" / kind
    content = path.read_bytes()
    broken = {"tag": struct.pack("<f", 1.5) + content[4:], "size": content[:-8], "empty": b""}[damage]
    path.write_bytes(broken)
    result = run_check(folder, tmp_path / "out" / "sequence.json")
    assert result.returncode == 2
    assert path.name in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "out" / "sequence.json").exists()


def test_truth_of_another_size(tmp_path: Path) -> None:
    folder = sintel_clip(tmp_path)
    sintel.write_dpt(tmp_path / "training/depth/clip/frame_0001.dpt", np.ones((10, 20)))
    result = run_check(folder, tmp_path / "sequence.json")
    assert result.returncode == 2
    assert "64 x 48 like the frames, found 20 x 10" in result.stderr


@pytest.mark.parametrize("kind", ["occlusions", "invalid", "clean_right", "final_right"])
def test_pictures_of_the_truth_are_read_too(tmp_path: Path, kind: str) -> None:
    """The evaluation reads them after minutes of work: what is wrong with them must stop before."""
    folder = sintel_clip(tmp_path)
    sequence = check_sequence("clip", folder)
    inspect_stage.check_truth(sequence)
    path = tmp_path / "training" / kind / "clip" / "frame_0001.png"
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), np.zeros((10, 20), np.uint8))
    with pytest.raises(InputError, match="64 x 48 like the frames, found 20 x 10"):
        inspect_stage.check_truth(check_sequence("clip", folder))


@pytest.mark.parametrize(
    ("pose", "phrase"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0])[:3], "a rotation matrix"),
        (np.diag([1.0, 1.0, 2.0, 1.0])[:3], "a rotation matrix"),
        (np.column_stack([np.eye(3), [0.0, np.nan, 0.0]]), "a finite translation"),
    ],
)
def test_cameras_that_cannot_be(tmp_path: Path, pose: np.ndarray, phrase: str) -> None:
    sintel.write_cam(tmp_path / "frame_0001.cam", np.eye(3), pose)
    with pytest.raises(InputError, match=phrase):
        inspect_stage.check_camera(tmp_path / "frame_0001.cam")


def test_a_linked_sequence_keeps_its_name(tmp_path: Path) -> None:
    """The workflow calls it by the link: under another name in its tables the report could not place its rows."""
    target = write_frames(tmp_path / "elsewhere" / "take_7")
    (tmp_path / "data").mkdir()
    link = tmp_path / "data" / "clip"
    link.symlink_to(target, target_is_directory=True)
    assert list(sequence_folders(tmp_path / "data", "final")) == list(sequence_folders(link, "final")) == ["clip"]
    inspect_stage.main(link, tmp_path / "sequence.json", tmp_path / "inspect.png", PartOptions())
    assert read_sequence(tmp_path / "sequence.json").name == "clip"


def test_an_output_folder_that_is_a_file(frames: Path) -> None:
    blocker = frames / "blocker"
    blocker.write_text("in the way")
    result = run_check(frames / "clip", blocker / "sequence.json")
    assert result.returncode == 2
    assert re.search(r"blocker: expected a folder that can be created, found .*; choose another", result.stderr)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_output_folder_without_permission(frames: Path) -> None:
    locked = frames / "locked"
    locked.mkdir(mode=0o500)
    result = run_check(frames / "clip", locked / "sequence.json")
    assert result.returncode == 2
    assert "no write permission" in result.stderr


def test_an_unknown_flag_is_one_line() -> None:
    command = [sys.executable, "-m", "stages.inspect", "--frame", "x"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=REPO, check=False)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
