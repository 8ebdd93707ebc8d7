"""Datasets of videos: indexes that are kept, folders of videos, pictures beside them, and the plan of every shot."""

import re
from pathlib import Path

import pytest
from conftest import REPO, run_snakemake, write_frames
from encoded_video import SIZE, encode, moving

from stages.configuration import config as configuration
from stages.configuration import datasets
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence
from stages.video.index import load_index
from stages.video.options import VideoOptions


def planned(values: dict[str, object]) -> dict[str, str]:
    """The folder of frames of every sequence of a configuration."""
    config = configuration.load(values)
    return datasets.frame_folders(config, datasets.video_shots(config))


def test_an_index_is_made_once_for_a_file_and_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video, kept = encode(tmp_path / "clip.mp4", moving(6)), tmp_path / "kept"
    made = load_index(video, VideoOptions(), kept)
    with monkeypatch.context() as patch:
        patch.setattr("stages.video.index.make_index", None)
        assert load_index(video, VideoOptions(), kept) == made
    assert len(load_index(video, VideoOptions(every=2), kept).shots["clip"].pts) == 3
    encode(video, moving(4))
    assert len(load_index(video, VideoOptions(), kept).shots["clip"].pts) == 4


def test_a_folder_of_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "data"
    folder.mkdir()
    encode(folder / "a.mp4", moving(4))
    encode(folder / "b.MOV", moving(4) + moving(4, seed=1))
    config = configuration.load({"dataset": "data"})
    shots = datasets.video_shots(config)
    monkeypatch.setattr("stages.video.index.load_index", None)  # the indexes are read once
    folders = datasets.frame_folders(config, shots)
    assert folders == {name: f"decoded/data/{name}" for name in ("a", "b_shot1", "b_shot2")}
    sequences = datasets.find_sequences(config, folders, shots)
    assert (sequences["b_shot2"].numbers, sequences["a"].width) == ([5, 6, 7, 8], SIZE[0])  # counted over the clip
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert list(planned({"dataset": "data", "sequences": ["b_shot2"]})) == ["b_shot2"]
    with pytest.raises(InputError, match="did you mean 'b_shot"):
        planned({"dataset": "data", "sequences": ["b_shot3"]})
    encode(folder / "a.mkv", moving(4))
    with pytest.raises(InputError, match=r"a\.m(kv|p4): expected a name of its own"):
        planned({"dataset": "data"})
    write_frames(folder / "frames")
    with pytest.raises(InputError, match=r"expected videos or folders of frames, found 'a.mkv' and 'frames/'"):
        planned({"dataset": "data"})


def test_videos_beside_pictures(tmp_path: Path) -> None:
    """A single picture is no sequence; with enough of them the video is left out, and the input check says so."""
    encode(tmp_path / "clip.mp4", moving(4))
    write_frames(tmp_path, count=1)
    said = "expected videos or at least 3 frames, found 'clip.mp4' and 1 picture, 'frame_0001.png'; move the pictures"
    with pytest.raises(InputError, match=said):
        planned({"dataset": str(tmp_path)})
    write_frames(tmp_path, count=3)
    assert planned({"dataset": str(tmp_path)}) == {tmp_path.name: str(tmp_path)}
    said = "'clip.mp4' beside the frames is not used: name it as the `dataset:` if you mean the video"
    assert said in check_sequence("clip", tmp_path).warnings


def test_tiny_frames_are_warned_of(tmp_path: Path) -> None:
    write_frames(tmp_path, size=(12, 16))
    assert any("16 x 12 px" in warning for warning in check_sequence("clip", tmp_path).warnings)


def test_a_name_with_marks_of_the_workflow_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_frames(tmp_path / "take {1}" / "left")
    clips = [encode(tmp_path / name, moving(4)) for name in ("clip {1}.mp4", "clip <1>.mp4")]
    for dataset in (*clips, tmp_path / "take {1}"):
        with pytest.raises(InputError, match=r"names without { } < >, found '(clip|take) [{<]1[}>]'; rename"):
            planned({"dataset": str(dataset)})


def test_a_strip_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    strip = encode(tmp_path / "strip.mp4", [image[:10] for image in moving(4)])
    with pytest.raises(InputError, match=r"strip\.mp4: expected frames .* 8 times the shorter one, found 96 x 10"):
        planned({"dataset": str(strip)})


def test_the_workflow_plans_every_shot_and_refuses_a_broken_video(tmp_path: Path) -> None:
    encode(tmp_path / "clip.mp4", moving(4) + moving(4, seed=1))
    arguments = ("-s", str(REPO / "Snakefile"), "-n", "poses", "--config")
    plan = run_snakemake(tmp_path, *arguments, "dataset=clip.mp4", "preset=fast")
    assert plan.returncode == 0, plan.stderr
    assert set(re.findall(r"results/clip/(\w+)/ba/poses", plan.stdout + plan.stderr)) == {"clip_shot1", "clip_shot2"}
    (tmp_path / "broken.mp4").write_bytes((tmp_path / "clip.mp4").read_bytes()[:-200])
    refused = run_snakemake(tmp_path, *arguments, "dataset=broken.mp4")
    assert refused.returncode == 2
    assert [line for line in refused.stderr.splitlines() if "broken.mp4: expected a video" in line]
    assert not (tmp_path / "decoded/broken").exists()
