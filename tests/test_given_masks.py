"""Masks that the user hands in: formats, names, checks, and what is not run for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import write_frames
from PIL import Image
from scipy import sparse

from stages.configuration import config as configuration
from stages.configuration import given_inputs, settings
from stages.export.clip import Clip
from stages.export.images import write_masks
from stages.given.masks import find_masks, read
from stages.segment import __main__ as segment_stage
from stages.segment.options import SegmentOptions
from stages.segment.permanence import solve
from stages.shared.artifacts import read_json, write_dense, write_json
from stages.shared.errors import InputError
from stages.shared.images import read_mask, read_numbers
from stages.shared.masks import instances_path, mask_path
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json

T, H, W = 4, 48, 64


@pytest.fixture
def frames(tmp_path: Path) -> Sequence:
    """Four frames in MPI-Sintel's layout, frame_0001.png to frame_0004.png."""
    return check_sequence("clip", write_frames(tmp_path / "training/final/clip"))


def labels() -> np.ndarray:
    """Two things [T, H, W] uint8, numbers 1 and 2, that move apart."""
    found = np.zeros((T, H, W), np.uint8)
    for k in range(T):
        found[k, 10:20, 10 + k : 20 + k] = 1
        found[k, 30:40, 40 - k : 50 - k] = 2
    return found


def write(folder: Path, images: list[Image.Image], name: str = "frame_{:04d}.png") -> Path:
    """A folder of PNG by another encoder than ours, numbered from 1."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(images, 1):
        image.save(folder / name.format(k))
    return folder


def palette(values: np.ndarray) -> Image.Image:
    """A palette image as DAVIS has them: the colours mean nothing."""
    image = Image.fromarray(values, "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    return image


def taken(folder: Path, frames: Sequence) -> tuple[np.ndarray, str]:
    """The labels [T, H, W] of a folder and their kind."""
    masks = read(find_masks(folder, frames), frames)
    return np.stack([masks.labels(k) for k in range(T)]), masks.kind


@pytest.mark.parametrize(
    ("encode", "kind"),
    [
        (lambda m: Image.fromarray((m > 0).astype(np.uint8) * 255), "binary"),
        (lambda m: Image.fromarray((m > 0).astype(np.uint8)), "binary"),
        (lambda m: Image.fromarray(m > 0), "binary"),
        (lambda m: Image.fromarray(np.repeat((m > 0)[..., None] * np.uint8(255), 3, axis=2)), "binary"),
        (palette, "instances"),
        (Image.fromarray, "instances"),
        (lambda m: Image.fromarray(m.astype(np.uint16)), "instances"),
    ],
)
def test_every_way_to_write_a_mask_is_read(tmp_path: Path, frames: Sequence, encode: object, kind: str) -> None:
    found, of_kind = taken(write(tmp_path / "masks", [encode(m) for m in labels()]), frames)  # type: ignore[operator]
    assert of_kind == kind
    assert np.array_equal(found, labels() if kind == "instances" else labels() > 0)


def test_soft_borders_of_resized_masks_are_no_instances(tmp_path: Path, frames: Sequence) -> None:
    sharp = [Image.fromarray((m > 0).astype(np.uint8) * 255) for m in labels()]
    soft = [
        image.resize((48, 36), Image.Resampling.BILINEAR).resize((W, H), Image.Resampling.BICUBIC) for image in sharp
    ]
    smooth = [Image.fromarray(np.where(np.array(a) > 30, np.array(b), 0)) for a, b in zip(sharp, soft, strict=True)]
    found, kind = taken(write(tmp_path / "masks", smooth), frames)
    assert kind == "binary"
    assert np.array_equal(found, np.stack([np.array(image) > 127 for image in smooth]))
    shades = [Image.fromarray(np.arange(H * W, dtype=np.uint8).reshape(H, W)) for _ in range(T)]
    with pytest.raises(InputError, match="a number per instance, found 255 shades of grey"):
        taken(write(tmp_path / "shades", shades), frames)


@pytest.mark.parametrize("name", ["frame_{:04d}.png", "{}.png", "mask-{:05d}.png"])
def test_names_or_numbers_say_which_frame_a_file_belongs_to(tmp_path: Path, frames: Sequence, name: str) -> None:
    images = [Image.fromarray(m) for m in labels()]
    assert np.array_equal(taken(write(tmp_path / "masks", images, name), frames)[0], labels())
    later = replace(frames, frames=frames.frames[1:], numbers=frames.numbers[1:])
    assert [path.name for path in find_masks(tmp_path / "masks", later)] == [name.format(k) for k in (2, 3, 4)]


def test_masks_of_colmap_mark_what_stays(tmp_path: Path, frames: Sequence) -> None:
    """What the export writes for COLMAP, black where something moves, comes back as it was."""
    folder = tmp_path / "masks"
    folder.mkdir()
    names = [path.name for path in frames.frames]
    parts = {"content": frames, "names": names, "mask": lambda _, k: labels()[k] > 0}
    clip = type("Fixed", (Clip,), {"__init__": lambda _: None, **parts})
    write_masks(folder, clip())
    assert (folder / "frame_0001.png.png").exists()
    found, kind = taken(folder, frames)
    assert kind == "binary, black moves"
    assert np.array_equal(found, labels() > 0)


def binary(moving: np.ndarray) -> Image.Image:
    """A mask [H, W] as 0 and 255."""
    return Image.fromarray(moving.astype(np.uint8) * 255)


WRONG = {
    "too few": ([binary(m > 0) for m in labels()[:3]], "every frame.*3 of 4.*none for 'frame_0004.png'"),
    "smaller": ([binary(m[::2, ::2] > 0) for m in labels()], "64 x 48.*32 x 24, the frames scaled by 0.5"),
    "cropped": ([binary(m[:-8] > 0) for m in labels()], "64 x 48.*64 x 40, another shape"),
    "inverted": ([binary(m == 0) for m in labels()], "what moves.*9.% marked.*invert"),
    "coloured": ([Image.fromarray(np.dstack([m, m * 2, m])) for m in labels()], "grey or palette.*colours"),
    "none": ([], "folder of masks.*none of them"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_masks_are_refused_in_one_line(tmp_path: Path, frames: Sequence, wrong: str) -> None:
    images, said = WRONG[wrong]
    with pytest.raises(InputError, match=said):
        taken(write(tmp_path / "masks", images), frames)


def test_inverted_masks_of_large_movers_are_told(
    tmp_path: Path, frames: Sequence, caplog: pytest.LogCaptureFixture
) -> None:
    """Movers over 30 % of the view: inverted, their masks pass the limit."""
    marked = np.zeros((H, W), np.uint8)
    marked[: round(0.3 * H)] = 255
    taken(write(tmp_path / "right", [Image.fromarray(marked)] * T), frames)
    assert not caplog.messages
    taken(write(tmp_path / "inverted", [Image.fromarray(255 - marked)] * T), frames)
    assert "of the pixels as moving: invert them" in caplog.messages[0]


def test_two_files_for_a_frame_and_no_folder_are_refused(tmp_path: Path, frames: Sequence) -> None:
    for name in ("a{}.png", "b{}.png"):
        write(tmp_path / "masks", [binary(m > 0) for m in labels()], name)
    with pytest.raises(InputError, match=r"one file of masks per frame, found 'a1.png', 'b1.png'"):
        taken(tmp_path / "masks", frames)
    with pytest.raises(InputError, match=r"folder of masks.*nothing there"):
        taken(tmp_path / "other", frames)


def run_segment(frames: Sequence, folder: Path, source: str) -> Path:
    """The masks that the stage writes, without flow and without a prior."""
    folder.mkdir()
    write_json(folder / "sequence.json", sequence_to_json(frames))
    segment_stage.main(folder / "sequence.json", folder / "masks", folder / "figure.png", SegmentOptions(source=source))
    return folder / "masks"


def test_given_true_masks_are_the_truth(tmp_path: Path, frames: Sequence) -> None:
    truth = write(
        tmp_path / "training/motion_mask/clip", [Image.fromarray((m > 0).astype(np.uint8) * 255) for m in labels()]
    )
    frames = check_sequence("clip", frames.frames[0].parent)
    ours, true = (
        run_segment(frames, tmp_path / "a", str(truth.parent / "{sequence}")),
        run_segment(frames, tmp_path / "b", "truth"),
    )
    for number in frames.numbers:
        for path in (mask_path, instances_path):
            assert path(ours, number).read_bytes() == path(true, number).read_bytes()
    about = read_json(ours / "masks.json")
    assert about["given"] == "binary"
    assert about["dynamic_share"] == read_json(true / "masks.json")["dynamic_share"]


def test_given_instances_keep_their_numbers(tmp_path: Path, frames: Sequence) -> None:
    folder = write(tmp_path / "things", [palette(m) for m in labels()])
    masks = run_segment(frames, tmp_path / "a", str(folder))
    for k, number in enumerate(frames.numbers):
        assert np.array_equal(read_numbers(instances_path(masks, number)), labels()[k])
        assert np.array_equal(read_mask(mask_path(masks, number)), labels()[k] > 0)
    assert set(read_json(masks / "masks.json")["instances"]) == {"1", "2"}


def test_paths_are_checked_before_any_work(tmp_path: Path, frames: Sequence) -> None:
    elsewhere = [tmp_path / "other" / path.name for path in frames.frames]
    two = {"clip": frames, "other": replace(frames, name="other", frames=elsewhere)}

    def check(path: object, sequences: dict[str, Sequence]) -> None:
        given_inputs.check([(settings.configured({"segment": {"source": str(path)}}), sequences.values())])

    write(tmp_path / "masks/clip", [Image.fromarray(m) for m in labels()])
    check(tmp_path / "masks/{sequence}", {"clip": frames})
    check("truth", two)
    with pytest.raises(
        InputError, match=r"segment.source: expected refined.*or a path.*'refind'; did you mean 'refined'"
    ):
        check("refind", two)
    with pytest.raises(InputError, match=r"\{sequence\} in the path, for the names of 2 sequences"):
        check(tmp_path / "masks/clip", two)
    with pytest.raises(InputError, match=r"other: expected a folder of masks.*nothing there"):
        check(tmp_path / "masks/{sequence}", two)
    first = configuration.load({"segment": {"source": str(tmp_path / "masks/clip")}})
    before = given_inputs.digest(first, "segment", frames)
    (tmp_path / "masks/clip/frame_0001.png").touch()
    assert given_inputs.digest(first, "segment", frames) != before
    assert given_inputs.digest(first, "flow", frames) == ""


def test_stated_masks_are_strong_evidence_but_not_the_last_word() -> None:
    """Superpixels without links: motion and masks meet in their weighted mean."""
    alone, ones = sparse.csr_matrix((3, 3)), np.ones(3)
    motion, stated = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    sure, unsure = (solve(alone, ones, motion, share * ones, stated) for share in (1.0, 0.0))
    assert sure[0] > 0.8  # marked, though it seems to rest
    assert 0.5 < sure[1] < 0.8  # not marked, though it surely moves
    assert unsure[0] > 0.99
    assert max(unsure[1], sure[2], unsure[2]) < 0.01
    assert solve(alone, ones, motion, ones)[:2] == pytest.approx(motion[:2])


def test_masks_as_evidence_add_what_does_not_move(tmp_path: Path, frames: Sequence) -> None:
    """A thing that stands out in colour, at rest in all frames: only the masks tell that it belongs to what moves."""
    thing = np.zeros((H, W), bool)
    thing[12:36, 16:48] = True
    picture = np.where(thing[..., None], (200, 60, 40), (40, 90, 160)).astype(np.uint8)
    for path in frames.frames:
        Image.fromarray(picture).save(path)
    still = np.zeros((T, H, W), np.float32)
    write_dense(tmp_path / "prior.arrow", {"frame": np.arange(1, T + 1), "probability": still, "weight": still})
    links = {"source": np.arange(T - 1), "target": np.arange(1, T), "flow": np.zeros((T - 1, H, W, 2), np.float16)}
    write_dense(tmp_path / "pairs.arrow", links | {"confidence": np.ones((T - 1, H, W), np.float16)})
    write_json(tmp_path / "sequence.json", sequence_to_json(frames))
    folder = write(tmp_path / "people", [binary(thing)] * T)
    shares = {}
    for evidence in (None, str(folder)):
        outputs = tmp_path / "masks", tmp_path / "figure.png"
        options = SegmentOptions(evidence=evidence)
        files = tmp_path / "pairs.arrow", tmp_path / "prior.arrow"
        segment_stage.main(tmp_path / "sequence.json", *outputs, options, *files)
        found = read_mask(mask_path(tmp_path / "masks", 2))
        shares[evidence] = (found & thing).sum() / (found | thing).sum()
    assert shares[None] == 0
    assert shares[str(folder)] > 0.9
