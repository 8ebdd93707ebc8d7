"""Shots of folders of frames: cuts are found to the frame, and each shot is a sequence of its own."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from conftest import REPO, run_snakemake, write_scenes
from encoded_video import SIZE, encode, moving

from stages.ba import cuts
from stages.ba.estimate import _observed
from stages.configuration import config as configuration
from stages.configuration import datasets, given_inputs, settings
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.report.clips import shot_lines
from stages.shared.artifacts import read_json
from stages.shared.errors import InputError
from stages.shared.sequences import read_sequence
from stages.shared.tables import read_rows
from stages.video import __main__ as video_stage
from stages.video import shots
from stages.video.folders import find_ranges
from stages.video.shots import Look


def grey(images: list[np.ndarray]) -> list[np.ndarray]:
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]


def ranges(images: list[np.ndarray], first: int = 1) -> list[tuple[int, int]]:
    return find_ranges(images, list(range(first, first + len(images))))


def texture(count: int, seed: int, step: int = 2) -> list[np.ndarray]:
    """Frames [72, 128] uint8 of a texture that moves by `step` px per frame."""
    return grey(moving(count, seed, (step, 0), (128, 72)))


def write(folder: Path, images: list[np.ndarray], first: int = 1) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(images, start=first):
        cv2.imwrite(str(folder / f"frame_{number:04d}.png"), image)
    return folder


@pytest.mark.parametrize(
    ("blank", "observed"), [((2, 5, 8), True), ((5,), True), ((), True), ((0, 2, 4, 6, 8, 10), False)]
)
def test_blank_frames_between_others_do_not_fail_a_clip(blank: tuple[int, ...], observed: bool) -> None:
    """White frames of a strobe: of its neighbours most share nothing, of the frames that show something all do."""
    pairs = [(i, i + step) for step in (1, 2) for i in range(11 - step)]
    source, target = np.array(pairs).T
    weights = np.ones((len(pairs), 500), np.float32)
    weights[np.isin(source, blank) | np.isin(target, blank)] = 0
    graph = SimpleNamespace(source=source, target=target, weights=weights, T=11)
    assert _observed(graph) is observed  # type: ignore[arg-type]


def test_cuts_are_found_to_the_frame() -> None:
    clip = texture(9, 0) + texture(4, 1) + texture(12, 2)
    assert ranges(clip, first=17) == [(17, 25), (26, 29), (30, 41)]


@pytest.mark.parametrize("size", [(1024, 96), (1024, 20), (20, 300), (9, 7)])
def test_cuts_are_found_in_strips_and_in_tiny_frames(size: tuple[int, int]) -> None:
    """OpenCV's presets of flow crash the process on images of less than 32 px."""
    random, (w, h) = np.random.default_rng(0), size
    first, second = (random.integers(0, 255, (h, w), np.uint8) for _ in range(2))
    looks = [Look(k, float(k), image) for k, image in enumerate([first] * 4 + [second] * 4)]
    assert [shot.pts for shot in shots.find_shots(looks, repeated=True).shots] == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_a_whip_pan_is_no_cut() -> None:
    """Coarse flow finds no shift of a third of the view; a translation does."""
    steady = texture(72, 0)
    assert ranges([steady[k] for k in (0, 1, 2, 3, 4, 25, 46, 67, 68, 69, 70, 71)]) == [(1, 12)]


def test_exposure_jumps_noise_and_repeated_frames_are_no_cut() -> None:
    images = texture(10, 0)
    noise = np.random.default_rng(0).normal(0, 3, (10, 72, 128))
    gains = np.array([1, 1, 0.5, 0.5, 0.9, 0.3, 1, 1, 0.6, 1])[:, None, None]
    images = list(np.clip(np.array(images) * gains + noise, 0, 255).astype(np.uint8))
    assert ranges([*images[:4], images[3], images[3], *images[6:]]) == [(1, 10)]


@pytest.mark.parametrize("foreign", [1, 5])
def test_flashes_and_a_mover_that_fills_the_view_are_no_cut(foreign: int) -> None:
    """What covers the view for up to five frames stays within the shot, whether flat, or a texture that moves fast."""
    images = texture(20, 0)
    for k in range(foreign):
        images[8 + k] = np.full_like(images[0], 255)
    assert ranges(images) == [(1, 20)]
    images[8 : 8 + foreign] = texture(foreign, 3, step=50)
    assert ranges(images) == [(1, 20)]


def test_blank_frames_of_a_fade_are_in_no_shot() -> None:
    first, second = (np.array(texture(12, seed), float) for seed in (0, 1))
    out, into = first * np.linspace(1, 0, 12)[:, None, None], second * np.linspace(0, 1, 12)[:, None, None]
    found = ranges([image.astype(np.uint8) for image in (*out, *np.zeros((8, 72, 128)), *into)])
    assert len(found) == 2
    assert found[0][0] == 1
    assert 9 <= found[0][1] <= 12
    assert 21 <= found[1][0] <= 24
    assert found[1][1] == 32


def test_a_clip_that_shows_nothing_is_one_shot() -> None:
    assert ranges(list(np.zeros((6, 72, 128), np.uint8))) == [(1, 6)]


def sequences(values: dict[str, object]) -> tuple[dict[str, list[int]], dict[str, str]]:
    """The numbers of the frames of every sequence of a configuration, and what is left out of its clip."""
    config = configuration.load(values)
    shots = datasets.video_shots(config)
    whole = datasets.find_sequences(config, datasets.frame_folders(config, shots), shots)
    found, parts = datasets.divided(config, whole, shots)
    return {name: one.numbers for name, one in found.items()}, {name: part.left_out for name, part in parts.items()}


def test_every_shot_of_a_folder_is_a_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "data" / "two", texture(6, 0) + texture(7, 1) + texture(2, 2), first=11)
    write(tmp_path / "data" / "one", texture(5, 0))
    found, left_out = sequences({"dataset": "data"})
    shots = {"two_shot1": [*range(11, 17)], "two_shot2": [*range(17, 24)]}
    assert found == {"one": [1, 2, 3, 4, 5], **shots}
    told = "frames 24-25 are left out: fewer than 3 between cuts, or blank"
    assert left_out == {"two_shot1": told, "two_shot2": told}
    monkeypatch.setattr("stages.video.folders.find_shots", None)  # cuts are looked for once
    assert sequences({"dataset": "data", "sequences": ["two"]})[0] == shots
    assert sequences({"dataset": "data", "sequences": ["two_shot2"]})[0] == {"two_shot2": shots["two_shot2"]}
    assert list(sequences({"dataset": "data", "shots": "no"})[0]) == ["one", "two"]
    stated = {"two": [[11, 14], [20, 25]]}
    assert sequences({"dataset": "data", "shots": stated, "sequences": ["two"]})[0] == {
        "two_shot1": [11, 12, 13, 14],
        "two_shot2": [20, 21, 22, 23, 24, 25],
    }
    with pytest.raises(InputError, match="a sequence 'two_shot3', found 2 others; did you mean 'two_shot"):
        sequences({"dataset": "data", "sequences": ["two_shot3"]})


@pytest.mark.parametrize(
    ("shots", "message"),
    [
        ("yes", "expected auto, no, or shots of at least 3 frames"),
        ([[1, 2]], "as in \\[\\[1, 40\\], \\[41, 90\\]\\]"),
        ([[1, 5], [5, 9]], "one after the other"),
        ([[1, 5]], "shots by name for 2 clips, found one list of shots; write `shots: {a: "),
        ({"aa": "no"}, "expected names of clips of the dataset, found 'aa'; did you mean 'a'"),
        ({"a": [[2, 6]]}, "expected frames 1 to 5 of a, found \\[2, 6\\]; correct `shots`"),
    ],
)
def test_wrong_shots_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shots: object, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        write(tmp_path / "data" / name, texture(5, 0))
    with pytest.raises(InputError, match=message) as refused:
        sequences({"dataset": "data", "shots": shots})
    assert "\n" not in str(refused.value)


def test_stated_shots_of_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    images = moving(12)
    encode(tmp_path / "clip.mp4", images)
    found, _ = sequences({"dataset": "clip.mp4", "shots": [[1, 5], [7, 12]]})
    assert found == {"clip_shot1": [1, 2, 3, 4, 5], "clip_shot2": [7, 8, 9, 10, 11, 12]}
    options = video_stage.DecodeOptions(cuts=False, first=7, last=12)
    video_stage.main(tmp_path / "clip.mp4", tmp_path / "clip_shot2", tmp_path / "shot.json", options)
    written = sorted((tmp_path / "clip_shot2").iterdir())
    assert [path.name for path in written] == [f"frame_{n:04d}.png" for n in range(7, 13)]
    assert cv2.PSNR(cv2.imread(str(written[0])), images[6][..., ::-1].copy()) > 38
    assert read_json(tmp_path / "shot.json")["times_s"] == [k / 25 for k in range(6, 12)]
    assert images[0].shape[:2] == SIZE[::-1]


def test_a_shot_keeps_numbers_and_truth_and_the_report_groups_it(tmp_path: Path) -> None:
    frames = write(tmp_path / "training" / "final" / "clip", texture(9, 0))
    masks = write(tmp_path / "training" / "motion_mask" / "clip", [np.zeros((72, 128), np.uint8)] * 9)
    folders = []
    for k, (first, last) in enumerate(((1, 4), (5, 7)), start=1):
        folder = tmp_path / "results" / f"clip_shot{k}"
        folder.mkdir(parents=True)
        options = PartOptions(name=folder.name, first=first, last=last, left_out="frames 8-9 are left out")
        inspect_stage.main(frames, folder / "sequence.json", folder / "inspect.png", options)
        folders.append(folder)
    second = read_sequence(folders[1] / "sequence.json")
    assert (second.name, second.numbers) == ("clip_shot2", [5, 6, 7])
    assert second.truth["motion_mask"] == {n: masks / f"frame_{n:04d}.png" for n in (5, 6, 7)}
    assert second.warnings[-1] == "frames 8-9 are left out"
    said = "clip: 2 shots, clip_shot1 (frames 1-4), clip_shot2 (frames 5-7); frames 8-9 are left out"
    assert shot_lines(folders) == [said]


def test_the_plan_has_a_job_per_shot_and_none_more(tmp_path: Path) -> None:
    """Every shot has the jobs of a clip without cuts, which is planned as before: no job looks for cuts."""
    write(tmp_path / "data" / "two", texture(5, 0) + texture(5, 1))
    write(tmp_path / "data" / "one", texture(5, 0))
    arguments = ("-s", str(REPO / "Snakefile"), "-n", "poses", "--config", "dataset=data")
    plan = run_snakemake(tmp_path, *arguments)
    assert plan.returncode == 0, plan.stderr
    told = "video: has no effect: data holds no video; inspect.max_frames"
    assert told not in plan.stdout + plan.stderr
    other = run_snakemake(tmp_path, *arguments, "video={every: 2}")
    assert told in other.stdout + other.stderr
    jobs = Counter(re.findall(r"log: logs/data/(\w+)/", plan.stdout + plan.stderr))
    rounds = 4 * 3
    assert jobs == dict.fromkeys(("one", "two_shot1", "two_shot2"), rounds + 3)  # and inspect, flow, lens


def test_the_safety_net_names_the_shots_to_state() -> None:
    solved = np.arange(90) < 40
    (said,) = cuts.warnings(solved, list(range(11, 101)))
    assert "too few confident matches join frames 51-100 with the others" in said
    assert "`shots: [[11, 50], [51, 100]]`" in said


def test_where_no_shot_is_long_enough_none_is_advised() -> None:
    """As of a strobe, every third frame of which is white: an empty list is refused."""
    (said,) = cuts.warnings(np.arange(1, 12) % 3 != 0, list(range(1, 12)))
    assert said.endswith(
        "join frames 3, 6, 9 with the others; leave out what shows nothing, and number the frames anew"
    )


def test_given_files_of_a_clip_serve_its_shots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames keep their numbers, so that one folder of masks is right for all shots of a clip, not for two."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "data" / "clip", texture(10, 0))
    masks = write(tmp_path / "masks", [np.zeros((72, 128), np.uint8)] * 10)
    values = {"dataset": "data", "shots": [[1, 4], [6, 10]], "segment": {"source": str(masks)}}
    config = configuration.load(values)
    whole = datasets.find_sequences(config, datasets.frame_folders(config, {}), {})
    shots, _ = datasets.divided(config, whole, {})
    setting = settings.configured(values)
    given_inputs.check([(setting, shots.values())])
    other = replace(whole["clip"], name="b", frames=[tmp_path / "b" / path.name for path in whole["clip"].frames])
    with pytest.raises(InputError, match=r"\{sequence\} in the path"):
        given_inputs.check([(setting, [*shots.values(), other])])


@pytest.mark.long
def test_both_shots_of_a_clip_are_solved_and_scored(tmp_path: Path) -> None:
    """The whole pipeline on a scene in two shots: each has its poses, its scores against the truth, and its section."""
    write_scenes(tmp_path, 12, 256, 112)
    options = {
        "dataset": "simulated",
        "scenes": ["still.yaml"],
        "shots": [[1, 6], [7, 12]],
        "preset": "fast",
        "rounds": 1,
        "control": {"steps": 20},
        "gaussians": {"steps": 20},
        "render": {"novel_views": 2},
        "colmap": {"window": 2},
    }
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(options))
    run = run_snakemake(tmp_path, "-s", str(REPO / "Snakefile"), "--configfile", "mine.yaml")
    assert run.returncode == 0, run.stderr[-4000:]
    for k in (1, 2):
        rows = read_rows(tmp_path / f"results/simulated/still_shot{k}/eval/poses.parquet")
        ours = next(row for row in rows if row["method"] == "ours")
        assert (ours["registered"], ours["total"]) == (6, 6)
        assert ours["ate_percent"] < 5
    page = (tmp_path / "results/simulated/report/index.html").read_text()
    assert "Shots of still: 2 shots, still_shot1 (frames 1-6), still_shot2 (frames 7-12)" in page
