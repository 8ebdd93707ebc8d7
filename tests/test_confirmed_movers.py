"""The segment stage with the cameras of the round before: the pictures make movers whole, and confirm weak ones."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from passing_square import GROUND_PX, H, T, W, clip, flow_columns, left_part, square, static_cameras

from stages.segment import __main__ as segment_stage
from stages.segment import layers, network, refined, refinement
from stages.segment.layers import Belonging
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC, Links
from stages.segment.superpixels import Superpixels
from stages.shared.artifacts import write_dense, write_json
from stages.shared.cameras import scale_intrinsics, write_cameras
from stages.shared.errors import InputError
from stages.shared.images import read_mask, write_image
from stages.shared.sequences import check_sequence, sequence_to_json

PREVIOUS = "poses.parquet", "depth.arrow"
"""Cameras and depth of the round before."""


def masks_of(folder: Path, prior: np.ndarray, weight: float, noise: float = 0.0) -> Callable[..., list[np.ndarray]]:
    """Masks [H, W] bool of the clip by the stage, from a prior [T, H, W] and, if their files are given, the cameras.

    Frames have twice the size of the flow, as flow is often found on smaller frames, and noise of this standard
    deviation in levels.
    """
    random = np.random.default_rng(7)
    for k, rgb in enumerate(clip(60)):
        double = cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        noisy = np.clip(double + noise * random.standard_normal(double.shape), 0, 255).astype(np.uint8)
        write_image(folder / "clip" / f"frame_{k + 1:04d}.png", noisy if noise else double)
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("clip", folder / "clip")))
    write_dense(folder / "pairs.arrow", flow_columns(), {"width": W, "height": H, "scale": 0.5})
    evidence = {"frame": np.arange(1, T + 1), "probability": prior.astype(np.float16)}
    evidence["weight"] = np.full(prior.shape, weight, np.float16)
    evidence["static_depth"] = np.ones(prior.shape, np.float16)
    write_dense(folder / "prior.arrow", evidence)
    cameras = static_cameras()
    write_cameras(folder / "poses.parquet", replace(cameras, Ks=scale_intrinsics(cameras.Ks, 2)))
    cells = {"inverse_depth": np.ones((T, H // 4, W // 4), np.float32)}
    write_dense(folder / "depth.arrow", cells, {"stride_px": 8.0})

    def masks(*previous: str, borders: Literal["learned", "geometric"] = "geometric") -> list[np.ndarray]:
        options = SegmentOptions(borders=borders)
        inputs = folder / "sequence.json", folder / "masks", folder / "segment.png", options
        evidence = folder / "pairs.arrow", folder / "prior.arrow"
        segment_stage.main(*inputs, *evidence, *(folder / name for name in previous))
        return [read_mask(folder / f"masks/frame_{k + 1:04d}.png")[::2, ::2] for k in range(T)]

    return masks


def test_loud_noise_is_smoothed_before_pictures_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a mover whose left part is known the pictures show the rest, at night as well."""
    masks = masks_of(tmp_path, np.stack([left_part(k) for k in range(T)]), weight=1.0, noise=30)

    def overlap() -> float:
        found = zip(masks(*PREVIOUS), map(square, range(T)), strict=True)
        return float(np.mean([(mask & mover).sum() / (mask | mover).sum() for mask, mover in found]))

    smooth = overlap()
    monkeypatch.setattr(refined, "smoothed", lambda rgb, _: rgb)
    assert smooth > overlap() + 0.15
    monkeypatch.setattr(layers, "noise_of", lambda frame, *_: np.zeros(frame.shape[:2], np.float32))
    assert smooth > overlap() + 0.05, "nor without noise among what right matches differ by"


def test_cameras_of_the_round_before_make_a_mover_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its flow is known in its left part alone; the pictures show the rest."""
    masks = masks_of(tmp_path, np.stack([left_part(k) for k in range(T)]), weight=1.0)

    def overlaps(*previous: str) -> list[float]:
        found = zip(masks(*previous), map(square, range(T)), strict=True)
        return [(mask & mover).sum() / (mask | mover).sum() for mask, mover in found]

    alone, together = overlaps(), overlaps(*PREVIOUS)
    assert min(np.subtract(together, alone)) > 0.02
    assert np.mean(together) > np.mean(alone) + 0.05
    with monkeypatch.context() as patch:
        patch.setattr(refinement, "SHOWN_WEIGHT", 0.0)
        blunt = overlaps(*PREVIOUS)
    assert np.mean(together) > np.mean(blunt) + 0.02, "borders follow what single pixels show"
    asked, of_frame = [], Belonging.of_frame
    with monkeypatch.context() as patch:
        patch.setattr(Belonging, "of_frame", lambda shown, k: asked.append(k) or of_frame(shown, k))
        overlaps(*PREVIOUS)
    assert set(asked) == set(range(T)), "each frame's mask goes by the pixels of that frame"
    with pytest.raises(InputError, match="together with --previous-depth"):
        overlaps("poses.parquet")
    lost = replace(static_cameras(), status=np.full(T, "failed", object))
    write_cameras(tmp_path / "poses.parquet", lost)
    assert overlaps(*PREVIOUS) == alone


def test_borders_are_learned_unless_they_are_to_be_geometric(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that denies whatever it is asked takes the border away, but where it is not asked for."""
    shipped = network.read_network()
    denies = shipped._replace(last=0 * shipped.last, last_bias=np.float32([-1e3]))
    monkeypatch.setattr(network, "read_network", lambda: denies)
    masks = masks_of(tmp_path, np.stack([left_part(k) for k in range(T)]), weight=1.0)
    learned, without_cameras = masks(*PREVIOUS, borders="learned"), masks(borders="learned")
    geometric, alone = masks(*PREVIOUS), masks()
    assert sum(of.sum() for of in learned) < 0.5 * sum(of.sum() for of in geometric)
    for one, other in zip(without_cameras, alone, strict=True):
        np.testing.assert_array_equal(one, other)


def silent(pixels: Superpixels, *_: object) -> Belonging:
    """As `belonging`, of pictures that were compared everywhere and show nothing."""
    none = np.zeros(len(pixels.areas))
    return Belonging(none, none + 1, np.zeros((T, H, W), np.int8), np.zeros((T, 6, H, W), np.uint8))


def test_what_floats_beside_a_mover_is_part_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its right part is seen at rest, but before the wall, and the pictures say nothing."""
    masks = masks_of(tmp_path, np.stack([left_part(k) for k in range(T)]), weight=1.0)
    right = np.stack([square(k) & ~left_part(k) for k in range(T)])
    cells = {"inverse_depth": np.where(right, np.float32(1.5), np.float32(1))[:, 2::4, 2::4]}
    write_dense(tmp_path / "depth.arrow", cells, {"stride_px": 8.0})

    monkeypatch.setattr("stages.segment.layers.belonging", silent)
    assert (np.stack(masks(*PREVIOUS)) & right).sum() > 0.8 * right.sum()
    monkeypatch.setattr("stages.segment.floating.floating", lambda linked, *_: np.zeros(len(linked.pixels.areas), bool))
    assert (np.stack(masks(*PREVIOUS)) & right).sum() < 0.5 * right.sum()


def test_what_floats_confirms_no_weak_mover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is asked about, and the pictures do not show that it moves."""
    masks = masks_of(tmp_path, np.stack([np.where(left_part(k), 0.59, 0.02) for k in range(T)]), weight=0.667)
    beside = np.stack([square(k) & ~left_part(k) for k in range(T)]).astype(float)

    def floats(linked: Links, _: object, sure: np.ndarray) -> np.ndarray:
        return np.asarray((linked.pixels.means(beside) > 0.5) & (sure >= DYNAMIC).any())

    monkeypatch.setattr("stages.segment.floating.floating", floats)
    monkeypatch.setattr("stages.segment.layers.belonging", silent)
    assert not np.any(masks(*PREVIOUS))


def test_a_weak_mover_is_kept_if_the_pictures_confirm_it(tmp_path: Path) -> None:
    """Its flow alone is not enough."""
    prior = np.stack([np.where(left_part(k), 0.59, 0.02) for k in range(T)])
    masks = masks_of(tmp_path, prior, weight=0.667)
    assert not np.any(masks())
    found = zip(masks(*PREVIOUS), map(square, range(T)), strict=True)
    assert all((mask & mover).sum() > 0.5 * (mask | mover).sum() for mask, mover in found)


@pytest.mark.parametrize("borders", ["learned", "geometric"])
def test_what_no_picture_was_compared_with_is_kept(tmp_path: Path, borders: Literal["learned", "geometric"]) -> None:
    """As where the cameras of most frames are not known, so that these say nothing."""
    prior = np.stack([np.where(square(k), 0.54, 0.02) for k in range(T)])
    masks = masks_of(tmp_path, prior, weight=0.667)
    alone = masks()
    assert all(mask.sum() > 1000 for mask in alone)
    cameras = static_cameras()
    seen = np.where(np.arange(T) < 1, "estimated", "unobserved").astype(object)
    lost = replace(cameras, Ks=scale_intrinsics(cameras.Ks, 2), status=seen)
    write_cameras(tmp_path / "poses.parquet", lost)
    np.testing.assert_array_equal(masks(*PREVIOUS, borders=borders), alone)


def test_ground_that_seems_to_move_is_dropped_if_the_pictures_do_not_confirm_it(tmp_path: Path) -> None:
    prior = np.full((T, H, W), 0.02)
    for k in range(T):
        prior[k, 24:72, 24 + GROUND_PX * k : 72 + GROUND_PX * k] = 0.54
    masks = masks_of(tmp_path, prior, weight=0.667)
    assert all(mask.sum() > 1000 for mask in masks())
    assert not np.any(masks(*PREVIOUS))
