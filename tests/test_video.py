"""Videos become sequences of frames: pixels, time stamps, shots and findings against what was encoded."""

import re
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from encoded_video import SIZE, encode, encode_sound, moving

from stages.configuration import config as configuration
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared.artifacts import read_json
from stages.shared.errors import InputError
from stages.shared.images import read_rgb
from stages.shared.sequences import read_sequence
from stages.video import __main__ as video_stage
from stages.video.decode import _deinterlaced, end_option
from stages.video.index import Index, make_index
from stages.video.options import VideoOptions


def indexed(video: Path, **options: object) -> Index:
    return make_index(video, VideoOptions(**options))  # type: ignore[arg-type]


def decoded(video: Path, folder: Path, **options: object) -> list[np.ndarray]:
    """The frames that the stage writes for the first shot of a video."""
    video_stage.main(video, folder / "frames", folder / "frames.json", video_stage.DecodeOptions(**options))  # type: ignore[arg-type]
    return [read_rgb(path) for path in sorted((folder / "frames").glob("frame_*.png"))]


def psnr(images: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """The least PSNR of all frames."""
    assert [image.shape for image in images] == [image.shape for image in truth]
    return min(cv2.PSNR(image, true) for image, true in zip(images, truth, strict=True))


def test_frames_and_times_are_those_that_were_encoded(tmp_path: Path) -> None:
    images = moving(8)
    written = decoded(encode(tmp_path / "clip.mp4", images), tmp_path)
    assert psnr(written, images) > 38
    assert min(psnr([a], [b]) for a, b in zip(written, images[1:], strict=False)) < 30  # each is its own frame
    about = read_json(tmp_path / "frames.json")
    assert about["times_s"] == [k / 25 for k in range(8)]
    assert (about["codec"], about["bits"], about["warnings"]) == ("h264", 8, [])


def test_ten_bit_frames_are_rounded_to_eight(tmp_path: Path) -> None:
    images = moving(5)
    video = encode(tmp_path / "clip.mkv", images, codec="ffv1", pix_fmt="yuv444p10le")
    assert psnr(decoded(video, tmp_path), images) > 45
    assert read_json(tmp_path / "frames.json")["bits"] == 10


def test_variable_frame_rate_keeps_every_time_stamp(tmp_path: Path) -> None:
    times_ms = [0, 33, 67, 167, 200, 233, 300]
    index = indexed(encode(tmp_path / "clip.mkv", moving(7), times_ms))
    assert index.shots["clip"].times_s == [ms / 1000 for ms in times_ms]
    assert any("0.033 to 0.100 s apart" in warning for warning in index.warnings)


def test_pixels_that_are_not_square_are_stretched(tmp_path: Path) -> None:
    images = moving(4)
    video = encode(tmp_path / "clip.mp4", images, aspect=2)
    assert (indexed(video).width, indexed(video).height) == (2 * SIZE[0], SIZE[1])


def test_black_bars_are_cut_off_on_both_sides_alike(tmp_path: Path) -> None:
    images = moving(5)
    framed = [np.pad(image, ((16, 16), (8, 0), (0, 0))) for image in images]
    video = encode(tmp_path / "clip.mp4", framed)
    inner = [image[18:-18] for image in framed]  # the bar at the left alone stays
    written = decoded(video, tmp_path)
    assert psnr(written, inner) > 38
    assert (indexed(video).width, indexed(video).height) == written[0].shape[1::-1]
    assert any("above and below are cut off, 18 px" in warning for warning in indexed(video).warnings)


def test_a_dark_picture_has_no_bars(tmp_path: Path) -> None:
    fading = np.clip(np.hypot(*np.mgrid[-32:32, -48:48]) / 20 - 0.5, 0, 1)[::-1]
    night = [(image * (1 - fading[..., None])).astype(np.uint8) for image in moving(5)]
    index = indexed(encode(tmp_path / "clip.mp4", night))
    assert (index.width, index.height, index.bars_px) == (*SIZE, (0, 0))


def test_fields_of_interlaced_frames_are_taken_apart(tmp_path: Path) -> None:
    images = moving(12, step=(4, 0))
    fields = [
        np.where(np.arange(SIZE[1])[:, None, None] % 2, b, a) for a, b in zip(images[::2], images[1::2], strict=True)
    ]
    video = encode(tmp_path / "clip.mkv", fields, pix_fmt="yuv420p", **{"x264-params": "tff=1"})
    written = decoded(video, tmp_path)
    comb = [np.abs(np.diff(image.astype(float), 2, axis=0)).mean() for image in (written[3], fields[3], images[6])]
    assert comb[2] < comb[0] < comb[1] / 4
    assert any("interlaced" in warning for warning in indexed(video).warnings)


def test_frames_are_taken_apart_from_the_first_interlaced_one_on(tmp_path: Path) -> None:
    """Joined material begins with whole frames."""
    frames, stream = [], None
    for name, options in (("whole", {}), ("fields", {"x264-params": "tff=1"})):
        video = av.open(str(encode(tmp_path / f"{name}.mkv", moving(4), pix_fmt="yuv420p", **options)))
        stream = video.streams.video[0]
        frames += list(video.decode(stream))
    for k, frame in enumerate(frames):
        frame.pts = 40 * k
    assert [was for _, was in _deinterlaced(iter(frames), stream)] == [False] * 4 + [True] * 4


def test_a_cut_makes_two_sequences(tmp_path: Path) -> None:
    first, second = moving(5), moving(6, seed=1)
    video = encode(tmp_path / "clip.mp4", first + second)
    index = indexed(video)
    assert {name: shot.times_s[0] for name, shot in index.shots.items()} == {"clip_shot1": 0, "clip_shot2": 0.2}
    assert psnr(decoded(video, tmp_path, shot=2), second) > 38


def test_a_flash_is_no_cut_and_a_lone_frame_no_shot(tmp_path: Path) -> None:
    images = moving(10)
    images[4] = np.full_like(images[4], 255)
    index = indexed(encode(tmp_path / "clip.mkv", [*images, *moving(2, seed=1)]))
    assert list(index.shots) == ["clip"]
    assert index.shots["clip"].times_s == [k / 25 for k in range(10) if k != 4]
    assert index.findings["left_out_s"] == [4 / 25, 10 / 25, 11 / 25]


def test_fast_motion_and_changing_brightness_are_no_cut(tmp_path: Path) -> None:
    images = [
        np.round(image * share).astype(np.uint8)
        for image, share in zip(moving(6, step=(9, 3)), (1, 0.5) * 3, strict=True)
    ]
    assert list(indexed(encode(tmp_path / "clip.mp4", images)).shots) == ["clip"]


def test_repeated_frames_are_left_out_with_their_times(tmp_path: Path) -> None:
    order = [0, 1, 1, 2, 3, 3, 3, 4]
    images = moving(5)
    noise = np.random.default_rng(0).integers(-2, 3, (len(order), *images[0].shape))
    shown = [
        np.clip(images[k].astype(int) + more, 0, 255).astype(np.uint8) for k, more in zip(order, noise, strict=True)
    ]
    video = encode(tmp_path / "clip.mp4", shown)
    assert psnr(decoded(video, tmp_path), images) > 35
    about = read_json(tmp_path / "frames.json")
    assert about["times_s"] == [0, 0.04, 0.12, 0.16, 0.28]
    assert about["duplicates_s"] == [0.08, 0.2, 0.24]


def test_options_choose_frames_and_size(tmp_path: Path) -> None:
    images = moving(20)
    video = encode(tmp_path / "clip.mp4", images, g="6")
    index = indexed(video, start=0.2, end=0.6, every=2, max_side=64)
    assert index.shots["clip"].times_s == [k / 25 for k in range(5, 16, 2)]
    assert (index.width, index.height) == (64, 42)
    written = decoded(video, tmp_path, start=0.2, end=0.6, every=2)
    assert psnr(written, images[5:16:2]) > 38
    first = indexed(video, max_frames=8)
    assert len(first.shots["clip"].pts) == 8
    assert any("0.280 s of 0.800 s: `video: {every: 3}`" in warning for warning in first.warnings)
    half = indexed(video, max_frames=10)
    assert any("0.360 s of 0.800 s: `video: {every: 2}`" in warning for warning in half.warnings)
    assert not indexed(video, max_frames=20).warnings
    beyond = indexed(video, max_frames=8, end=100)  # the video ends before
    assert any("0.280 s of 0.800 s: `video: {every: 3}`" in warning for warning in beyond.warnings)


@pytest.mark.parametrize(
    ("name", "container", "said"),
    [
        ("cut.mp4", {"movflags": "faststart"}, "expected a complete video, found one that cannot be decoded after"),
        ("cut.mkv", {"cluster_time_limit": "40"}, "expected 1.200 s, as its header says, found 0."),
    ],
)
def test_a_truncated_video_says_what_is_left_of_it(tmp_path: Path, name: str, container: dict, said: str) -> None:
    whole = encode(tmp_path / f"whole{name}", moving(30), container=container, g="8").read_bytes()
    cut = tmp_path / name
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError) as refused:
        indexed(cut)
    assert str(refused.value).startswith(f"{cut}: {said}")
    end = float(re.search(r"end: ([\d.]+)", str(refused.value))[1])  # type: ignore[index]
    assert indexed(cut, end=end).shots["cut"].times_s[-1] == end > 0.2


@pytest.mark.parametrize(("last_s", "end"), [(1 / 6, "0.166"), (0.1666, "0.166"), (0.28, "0.280"), (0.29, "0.290")])
def test_an_end_asks_for_no_frame_after_the_last_good_one(last_s: float, end: str) -> None:
    """Rounded up, it asked for the frame that cannot be decoded: 2 of 6 cuts at 24 frames per second had no way out."""
    assert end_option(last_s) == f"`video: {{end: {end}}}`"
    assert float(end) <= last_s


def test_a_matroska_file_whose_times_begin_late_is_complete(tmp_path: Path) -> None:
    """Its header tells when it ends, not how long it is."""
    late = encode(tmp_path / "late.mkv", moving(8), [5000 + 40 * k for k in range(8)])
    assert indexed(late).shots["late"].times_s == pytest.approx([k / 25 for k in range(8)])


def test_frames_whose_times_begin_anew_are_counted(tmp_path: Path) -> None:
    video = encode(tmp_path / "clip.ts", moving(6))
    video.write_bytes(2 * video.read_bytes())
    index = indexed(video)
    assert index.shots["clip"].times_s == [k / 25 for k in range(6)]
    assert [warning for warning in index.warnings if warning.startswith("6 frames are left out, whose time stamps")]


def test_a_size_that_changes_within_the_video_is_told_with_its_time(tmp_path: Path) -> None:
    images, video = moving(10), tmp_path / "clip.ts"
    parts = images[:6], [cv2.resize(image, (64, 64)) for image in images[6:]]
    times_ms = list(range(0, 240, 40)), list(range(240, 400, 40))
    for k in range(2):
        encode(tmp_path / f"{k}.ts", parts[k], times_ms[k])
    video.write_bytes((tmp_path / "0.ts").read_bytes() + (tmp_path / "1.ts").read_bytes())
    with pytest.raises(InputError, match=r"96 x 64 px like the first, found 64 x 64 px at 0\.240 s") as refused:
        indexed(video)
    end = float(re.search(r"end: ([\d.]+)", str(refused.value))[1])  # type: ignore[index]
    assert indexed(video, end=end).shots["clip"].times_s == [k / 25 for k in range(6)]


@pytest.mark.parametrize(
    ("make", "options", "phrases"),
    [
        (lambda path: path.write_bytes(b""), {}, ("an empty file",)),
        (lambda path: path.write_text("not a video " * 99), {}, ("a video", "cannot be opened")),
        (encode_sound, {}, ("a video", "sound alone")),
        (lambda path: encode(path, moving(1)), {}, ("at least 3 frames", "found 1 frame;")),
        (lambda path: encode(path, moving(1) * 9), {}, ("9 frames (8 of them repeat others)",)),
        (lambda path: encode(path, moving(9)), {"start": 2}, ("frames after `start`, 2 s", "0.360 s")),
        (lambda path: encode(path, moving(9)), {"start": 0.1, "end": 0.11}, ("until `end`, 0.11 s", "or `end` to")),
        (lambda path: encode(path, moving(9)), {"every": 5}, ("9 frames, one in 5 used", "smaller `video: {every")),
    ],
)
def test_what_is_no_video_gets_one_line(tmp_path: Path, make: object, options: dict, phrases: tuple[str, ...]) -> None:
    video = tmp_path / "clip.mp4"
    make(video)  # type: ignore[operator]
    with pytest.raises(InputError) as refused:
        indexed(video, **options)
    assert str(refused.value).startswith(f"{video}: expected ")
    assert "\n" not in str(refused.value)
    assert all(phrase in str(refused.value) for phrase in phrases), str(refused.value)


def test_a_text_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("notes " * 999)
    with pytest.raises(InputError, match=r"notes\.txt: expected a video, found a text; give"):
        indexed(tmp_path / "notes.txt")


def test_an_end_before_the_start_is_refused() -> None:
    with pytest.raises(InputError, match=r"video\.end: expected a time after `start`, 3 s"):
        configuration.load({"video": {"start": 3, "end": 2}})


def test_times_and_warnings_reach_the_sequence(tmp_path: Path) -> None:
    images = moving(8)
    images[5] = cv2.blur(images[5], (9, 1))
    decoded(encode(tmp_path / "clip.mp4", images, [0, 40, 80, 120, 200, 240, 280, 320]), tmp_path)
    inspect_stage.main(
        tmp_path / "frames",
        tmp_path / "sequence.json",
        tmp_path / "inspect.png",
        PartOptions(max_frames=7),
        tmp_path / "frames.json",
    )
    sequence = read_sequence(tmp_path / "sequence.json")
    assert sequence.stamps == [0, 0.04, 0.08, 0.12, 0.2, 0.24, 0.28]
    assert sequence.warnings[-1] == "blurred beside their neighbours: frames 6"
