"""Mask refinement: edges, specks, instances, and what the script writes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import write_frames

from stages.segment import __main__ as segment_stage
from stages.segment import boundaries
from stages.segment.colours import Learnt
from stages.segment.options import SegmentOptions
from stages.segment.refinement import (
    COLOUR_WEIGHT,
    SHOWN_WEIGHT,
    guarded_threshold,
    smooth_along_edges,
    to_instances,
    to_mask,
)
from stages.shared.artifacts import read_dense, read_json, write_dense, write_json
from stages.shared.errors import InputError
from stages.shared.images import read_mask, write_image
from stages.shared.sequences import check_sequence, sequence_to_json

OPTIONS = SegmentOptions()


def run(inputs: Sequence[Path], output: Path, figure: Path, options: SegmentOptions) -> None:
    """Run the stage on sequence, flow and prior."""
    sequence, *evidence = inputs
    segment_stage.main(sequence, output, figure, options, *evidence)


def painted(h: int = 80, w: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """A frame with a disc of another colour, and the disc."""
    v, u = np.mgrid[:h, :w]
    disc = (u - 60) ** 2 + (v - 40) ** 2 < 20**2
    rgb = np.where(disc[..., None], (200, 60, 40), (40, 90, 160)).astype(np.uint8)
    return rgb, disc


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / (found | truth).sum())


def test_masks_follow_colour_edges() -> None:
    """A prior with a halo of 5 px, on a coarser grid, is cut back to the object."""
    rgb, disc = painted()
    halo = cv2.dilate(disc.astype(np.float32), np.ones((11, 11)))
    prior = cv2.resize(cv2.GaussianBlur(halo, (0, 0), 3), (60, 40), interpolation=cv2.INTER_AREA)
    smoothed = smooth_along_edges(prior, rgb, 1000.0, 3.0)
    mask = to_mask(smoothed, 0.5, OPTIONS.min_area)
    naive = cv2.resize(prior, (120, 80)) > 0.5
    assert overlap(naive, disc) < 0.75
    assert overlap(mask, disc) > 0.95


def test_masks_follow_what_pictures_show_of_each_pixel() -> None:
    """A halo and a hidden part without colour edges: the pictures take away the one and add the other."""
    thing = np.zeros((80, 120), bool)
    thing[30:50, 40:80] = True
    taken, lacking = np.roll(thing, -8, axis=1) & ~thing, np.roll(thing, -8, axis=1) & thing
    prior = 0.2 + 0.5 * cv2.resize((taken | lacking).astype(np.float32), (60, 40), interpolation=cv2.INTER_AREA)
    shown = cv2.resize(np.where(thing, 1, -1).astype(np.float32), (60, 40), interpolation=cv2.INTER_AREA)
    rgb = np.full((80, 120, 3), 90, np.uint8)
    found = [to_mask(smooth_along_edges(prior, rgb, 1.0, 3.0, of), 0.5, OPTIONS.min_area) for of in (None, shown)]
    assert overlap(found[0], thing) < 0.75
    assert overlap(found[1], thing) > 0.9
    surest = to_mask(smooth_along_edges(prior / prior.max(), rgb, 1.0, 3.0, shown), 0.5, OPTIONS.min_area)
    assert (surest & taken).sum() > 0.7 * taken.sum(), "what is surest is not lost by the pictures alone"
    unseen = smooth_along_edges(prior, rgb, 1.0, 3.0, np.zeros_like(shown))
    np.testing.assert_array_equal(unseen, smooth_along_edges(prior, rgb, 1.0, 3.0))


@pytest.mark.parametrize("shows", [None, 0.0, 0.5, -0.5])
@pytest.mark.parametrize("colour", [0.3, -0.3])
def test_what_pictures_show_and_colours_say_add_up(shows: float | None, colour: float) -> None:
    """On a flat frame there are no edges to follow: what is left is a weighted mean."""
    rgb, sure = np.full((80, 120, 3), 90, np.uint8), np.full((40, 60), 0.15)
    shown = None if shows is None else np.full((40, 60), shows)
    found = smooth_along_edges(sure, rgb, 1.0, 3.0, shown, np.full((80, 120), colour, np.float32))
    total = SHOWN_WEIGHT * (shows or 0) + COLOUR_WEIGHT * colour
    np.testing.assert_allclose(found, (0.15 + max(total, 0)) / (1 + abs(total)), rtol=1e-5)


def test_specks_go_and_small_holes_close() -> None:
    probability = np.zeros((100, 100), np.float32)
    probability[20:60, 20:60] = 1.0
    probability[40:42, 40:42] = 0.0
    probability[80:82, 80:82] = 1.0
    mask = to_mask(probability, threshold=0.5, min_area=1e-3)
    assert mask[20:60, 20:60].all()
    assert mask.sum() == 1600


def test_a_mask_over_nearly_the_whole_frame_keeps_its_surest_part() -> None:
    sureness = np.linspace(0.4, 1, 10_000).reshape(100, 100)
    threshold = guarded_threshold(sureness, 0.5, max_share=0.6)
    assert (sureness > threshold).mean() == pytest.approx(0.6, abs=0.001)
    assert guarded_threshold(sureness, 0.9, max_share=0.6) == 0.9
    assert guarded_threshold(np.full((9, 9), 0.9), 0.5, max_share=0.6) == 0.5, "no part is surer than the rest"


def test_pixels_of_a_mask_take_the_nearest_instance() -> None:
    numbers = np.zeros((20, 30), int)
    numbers[5:10, 3:8], numbers[5:10, 20:25] = 2, 7
    mask = np.zeros((40, 60), bool)
    mask[8:22, 2:58] = True
    found = to_instances(mask, numbers)
    assert found.dtype == np.uint16
    assert (found[~mask] == 0).all()
    assert (found[8:22, 2:24] == 2).all()
    assert (found[8:22, 34:58] == 7).all()
    assert not to_instances(mask, np.zeros((20, 30), int)).any()


@pytest.fixture
def moving_disc(tmp_path: Path) -> tuple[Path, Path, Path, np.ndarray]:
    """sequence.json, pairs.arrow and prior.arrow on half the size of three frames, and the true mask."""
    clip = write_frames(tmp_path / "clip", count=3, size=(80, 120), first=7)
    rgb, disc = painted()
    for path in clip.iterdir():
        write_image(path, rgb)
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", clip)))
    source, target = np.array([[0, 1], [1, 0], [1, 2], [2, 1]]).T
    flow, confidence = np.zeros((4, 40, 60, 2), np.float16), np.ones((4, 40, 60), np.float16)
    columns = {"source": source, "target": target, "flow": flow, "confidence": confidence}
    write_dense(tmp_path / "pairs.arrow", columns, {"width": 60, "height": 40, "scale": 0.5})
    prior = cv2.resize(disc.astype(np.float32), (60, 40), interpolation=cv2.INTER_AREA)
    columns = {"frame": np.array([7, 8, 9]), "probability": np.stack([prior] * 3).astype(np.float16)}
    columns["weight"] = np.ones((3, 40, 60), np.float16)
    write_dense(tmp_path / "prior.arrow", columns)
    return tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "prior.arrow", disc


def test_script_writes_full_size_masks_by_frame_number(moving_disc: tuple[Path, ...], tmp_path: Path) -> None:
    *inputs, disc = moving_disc
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", OPTIONS)
    names = sorted(path.name for path in (tmp_path / "masks").glob("*.png"))
    assert names == ["frame_0007.png", "frame_0008.png", "frame_0009.png"]
    mask = read_mask(tmp_path / "masks" / "frame_0008.png")
    assert mask.shape == (80, 120)
    assert overlap(mask, disc) > 0.9
    facts = read_json(tmp_path / "masks" / "masks.json")
    assert facts["dynamic_share"]["8"] == pytest.approx(mask.mean())
    assert facts["guarded"] == []
    instances = cv2.imread(str(tmp_path / "masks/instances/frame_0008.png"), cv2.IMREAD_UNCHANGED)
    assert instances.dtype == np.uint16
    np.testing.assert_array_equal(instances, mask.astype(np.uint16))
    seen = facts["instances"]["1"]
    assert (seen["first_frame"], seen["last_frame"], seen["frames"]) == (7, 9, 3)
    assert seen["pixels"] == pytest.approx(mask.sum(), rel=0.1)


@pytest.fixture
def passing_disc(moving_disc: tuple[Any, ...]) -> tuple[Path, Path, Path, list[np.ndarray]]:
    """The same with a disc that goes 25 px to the right from frame to frame, and its true masks."""
    sequence, flow, prior, disc = moving_disc
    discs = [np.roll(disc, 25 * (k - 1), axis=1) for k in range(3)]
    for k, path in enumerate(sorted((sequence.parent / "clip").iterdir())):
        write_image(path, np.roll(painted()[0], 25 * (k - 1), axis=1))
    small = np.stack([cv2.resize(of.astype(np.float32), (60, 40), interpolation=cv2.INTER_AREA) for of in discs])
    pairs = dict(read_dense(flow))
    shift = 12.5 * (pairs["target"] - pairs["source"])
    moved = (small[pairs["source"]] > 0.5) * shift[:, None, None]
    pairs["flow"] = np.stack([moved, np.zeros_like(moved)], axis=-1).astype(np.float16)
    write_dense(flow, pairs, {"width": 60, "height": 40, "scale": 0.5})
    columns = {"frame": np.array([7, 8, 9]), "probability": small.astype(np.float16)}
    write_dense(prior, columns | {"weight": np.ones(small.shape, np.float16)})
    return sequence, flow, prior, discs


def test_each_frame_has_its_own_mask(passing_disc: tuple[Any, ...], tmp_path: Path) -> None:
    *inputs, discs = passing_disc
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", OPTIONS)
    for number, disc in zip((7, 8, 9), discs, strict=True):
        assert overlap(read_mask(tmp_path / f"masks/frame_{number:04d}.png"), disc) > 0.9
        numbers = cv2.imread(str(tmp_path / f"masks/instances/frame_{number:04d}.png"), cv2.IMREAD_UNCHANGED)
        assert overlap(numbers == 1, disc) > 0.9


def test_colours_decide_on_the_borders_of_each_frame(
    passing_disc: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here they deny the upper half of the disc."""
    *inputs, discs = passing_disc
    asked = []

    def denied(sureness: np.ndarray, rgb: np.ndarray, _: Learnt, others: list[Learnt]) -> np.ndarray:
        asked.append((sureness > 0.5, rgb, len(others)))
        return np.where(np.arange(80)[:, None] < 40, -1, 0) * np.ones(sureness.shape)

    monkeypatch.setattr(boundaries, "colour_evidence", denied)
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", OPTIONS)
    for number, disc, (before, rgb, others) in zip((7, 8, 9), discs, asked, strict=True):
        mask = read_mask(tmp_path / f"masks/frame_{number:04d}.png")
        assert others == 0, "none is three frames away"
        assert overlap(before, disc) > 0.9
        assert overlap(rgb[..., 0] > 100, disc) > 0.9, "each frame's own colours"
        assert not mask[:36].any()
        assert overlap(mask[44:], disc[44:]) > 0.8


@pytest.mark.parametrize(("permanence", "found"), [(0, False), (3, True)])
def test_the_options_reach_the_system(
    passing_disc: tuple[Any, ...], tmp_path: Path, permanence: float, found: bool
) -> None:
    """The disc shows in the first frame alone."""
    *inputs, _ = passing_disc
    columns = {name: values.copy() for name, values in read_dense(inputs[2]).items()}
    columns["probability"][1:] = 0.02
    write_dense(inputs[2], columns)
    options = SegmentOptions(permanence=permanence, threshold=0.2)
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", options)
    assert read_mask(tmp_path / "masks/frame_0008.png").any() == found


def test_evidence_of_little_weight_is_none(passing_disc: tuple[Any, ...], tmp_path: Path) -> None:
    *inputs, _ = passing_disc
    write_dense(inputs[2], dict(read_dense(inputs[2])) | {"weight": np.full((3, 40, 60), 0.1, np.float16)})
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", OPTIONS)
    assert not read_mask(tmp_path / "masks/frame_0008.png").any()


def test_frames_that_are_cut_back_are_named(passing_disc: tuple[Any, ...], tmp_path: Path) -> None:
    *inputs, discs = passing_disc
    run(inputs, tmp_path / "masks", tmp_path / "segment.png", SegmentOptions(max_share=0.1))
    assert read_json(tmp_path / "masks/masks.json")["guarded"] == [7, 8, 9]
    assert 0.02 < read_mask(tmp_path / "masks/frame_0008.png").mean() < 0.105 < discs[1].mean()


def test_a_prior_of_an_earlier_version_is_refused(moving_disc: tuple[Any, ...], tmp_path: Path) -> None:
    *inputs, _ = moving_disc
    columns = {name: values.copy() for name, values in read_dense(inputs[2]).items() if name != "weight"}
    write_dense(inputs[2], columns)
    with pytest.raises(InputError, match="run the motion stage again"):
        run(inputs, tmp_path / "masks", tmp_path / "segment.png", OPTIONS)


def with_true_mask(sequence: Path, frames: list[int]) -> np.ndarray:
    """Add truth of some frames to sequence.json: the left half moves."""
    truth = np.zeros((80, 120), bool)
    truth[:, :60] = True
    facts = read_json(sequence)
    write_image(sequence.parent / "truth.png", truth)
    facts["truth"]["motion_mask"] = {str(n): str(sequence.parent / "truth.png") for n in frames}
    write_json(sequence, facts)
    return truth


def test_sources_that_refinement_is_compared_with(moving_disc: tuple[Path, ...], tmp_path: Path) -> None:
    """The prior is cut at one half; none is empty; truth is the motion mask of the frame."""
    *inputs, disc = moving_disc
    truth = with_true_mask(inputs[0], [7, 8, 9])
    found = {}
    for source in ("prior", "none", "truth"):
        output = tmp_path / source
        run(inputs, output, tmp_path / "segment.png", SegmentOptions(source=source))
        found[source] = read_mask(output / "frame_0008.png")
    np.testing.assert_array_equal(found["truth"], truth)
    assert not found["none"].any()
    assert overlap(found["prior"], disc) > 0.9


def test_true_masks_must_be_there_for_every_frame(moving_disc: tuple[Path, ...], tmp_path: Path) -> None:
    *inputs, _ = moving_disc
    with_true_mask(inputs[0], [7, 8])
    with pytest.raises(InputError, match="motion_mask"):
        run(inputs, tmp_path / "masks", tmp_path / "segment.png", SegmentOptions(source="truth"))
    assert not (tmp_path / "masks").exists()
