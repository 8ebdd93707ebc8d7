"""What the pictures give to movers and to the static scene, where flow is lost."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.segment import __main__ as segment_stage
from stages.segment import layers, refinement, uncovered
from stages.segment.layers import MOVING, Belonging, belonging
from stages.segment.options import SegmentOptions
from stages.segment.permanence import persistent
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.shared import flow_pairs
from stages.shared.artifacts import Dense, write_dense, write_json
from stages.shared.cameras import Cameras, intrinsics, make_cameras, scale_intrinsics, write_cameras
from stages.shared.errors import InputError
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import read_mask, write_image
from stages.shared.sequences import check_sequence, sequence_to_json

T, H, W = 5, 96, 256
TILE_PX = 8
GROUND_PX, MOVER_PX = 2, -3
"""Motion to the right from frame to frame."""


def square(k: int) -> np.ndarray:
    """The mover in frame k, [H, W] bool; its flow is known on the left part alone."""
    mover = np.zeros((H, W), bool)
    mover[24:72, 120 + MOVER_PX * k : 184 + MOVER_PX * k] = True
    return mover


def left_part(k: int) -> np.ndarray:
    """The part of the mover that is known to move, [H, W] bool."""
    return square(k) & (np.arange(W) < 160 + MOVER_PX * k)


def clip(contrast: int, ground_px: int = GROUND_PX) -> np.ndarray:
    """Frames [T, H, W, 3] of a textured square before ground that a camera passes; with no contrast both are flat."""
    random = np.random.default_rng(0)
    noise = (random.normal(128, contrast, (H, 2 * W, 3)) for _ in range(2))
    ground, thing = (cv2.GaussianBlur(image, (0, 0), 1.5).clip(0, 255) for image in noise)
    frames = []
    for k in range(T):
        rgb = np.roll(ground, ground_px * k, axis=1)[:, :W]
        frames.append(np.where(square(k)[..., None], np.roll(thing, MOVER_PX * k, axis=1)[:, :W], rgb))
    return np.stack(frames).astype(np.uint8)


def flow_columns(ground_px: int = GROUND_PX) -> dict[str, np.ndarray]:
    """Flow of the ground everywhere but on the left part of the mover."""
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        flow[e, ..., 0] = np.where(left_part(i), MOVER_PX, ground_px) * (j - i)
    return {"source": source, "target": target, "flow": flow, "confidence": np.ones(flow.shape[:3], np.float32)}


def static_cameras(ground_px: int = GROUND_PX) -> Cameras:
    """Cameras that move to the left before a wall at depth 1: its picture moves by `ground_px` from frame to frame."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = ground_px / 100 * np.arange(T)
    return make_cameras(poses, intrinsics(100, 100, W / 2, H / 2), np.arange(1, T + 1))


def static_world(ground_px: int = GROUND_PX) -> StaticWorld:
    """These cameras and the wall."""
    cameras = static_cameras(ground_px)
    return StaticWorld(cameras, cameras.Ks, lambda _: np.ones((H, W), np.float32))


def tiles() -> Superpixels:
    """Squares of 8 px in place of superpixels."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    return Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), np.zeros(0))


def evidence(contrast: int, ground_px: int = GROUND_PX) -> tuple[Superpixels, Belonging]:
    """The tiles of a clip and what its pictures say, where the left part of the mover is known."""
    frames = clip(contrast, ground_px)
    pixels, pairs = tiles(), FlowPairs(Dense(flow_columns(ground_px)))
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()
    return pixels, belonging(pixels, pairs, lambda k: frames[k], static_world(ground_px), sure)


def inner(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without 8 px at its border, where tiles are mixed."""
    return cv2.erode(mask.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0


def test_what_moves_with_a_known_part_is_given_to_the_mover() -> None:
    pixels, found = evidence(contrast=60)
    for k in range(T):
        shown = pixels.paint(found.weight, k)
        assert np.median(shown[inner(square(k) & ~left_part(k))]) > 0.1 * MOVING


@pytest.mark.parametrize("ground_px", [GROUND_PX, 0])
def test_ground_beside_a_mover_is_given_to_the_static_scene(ground_px: int) -> None:
    """Also before a camera at rest: where nothing is known of a mover, its motion is not that of the ground."""
    pixels, found = evidence(contrast=60, ground_px=ground_px)
    for k in range(T):
        shown = pixels.paint(found.weight, k)
        near = np.zeros((H, W), bool)
        near[24:72, 92 + MOVER_PX * k : 120 + MOVER_PX * k] = True
        assert np.median(shown[inner(near)]) < 0
        assert (shown[inner(~square(k))] <= 0).all()
        assert (shown[:, :20] == 0).all(), "far from the mover its motion says nothing"


def test_what_pictures_show_fades_away_from_a_mover() -> None:
    """The farther its motion is extended, the less it says."""
    pixels, found = evidence(contrast=60)
    for k in range(T):
        left = 120 + MOVER_PX * k
        for shown in (pixels.paint(found.weight, k), found.of_frame(k)):
            near, far = (np.median(shown[32:64, left - px : left - px + 8]) for px in (14, 30))
            assert near < 2.5 * far < 0


def test_without_texture_nothing_is_given_to_either() -> None:
    _, found = evidence(contrast=0)
    assert (found.weight == 0).all()
    assert (found.pixels == 0).all()


def test_pixels_are_told_apart_within_a_superpixel() -> None:
    """Tiles of 8 px at the border of the mover hold ground as well; a pixel 3 px from the border is still told."""
    _, found = evidence(contrast=60)
    u, told = np.arange(W), {True: [], False: []}
    for k in range(T):
        left = 120 + MOVER_PX * k
        if left % TILE_PX in (3, 4, 5):
            mixed = slice(left // TILE_PX * TILE_PX, (left // TILE_PX + 1) * TILE_PX)
            rows = found.of_frame(k)[32:64, mixed]
            for moves in (True, False):
                told[moves] += [rows[:, (u[mixed] - left >= 3) if moves else (left - u[mixed] >= 3)]]
    moving, resting = (np.concatenate([part.ravel() for part in told[moves]]) for moves in (True, False))
    assert np.median(moving) > 0.5
    assert np.median(resting) < -0.5


@pytest.mark.parametrize("left", [136, 100])
def test_a_pixel_that_neither_explains_is_given_to_neither(left: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flicker on the mover or beside it: one motion matches a little better by chance."""
    random, frames = np.random.default_rng(1), clip(60)
    flicker = np.zeros((H, W), bool)
    flicker[32:64, left : left + 20] = True
    frames[:, flicker] = random.integers(0, 256, (T, int(flicker.sum()), 3))
    monkeypatch.setattr("test_mover_layers.clip", lambda *_: frames)
    _, found = evidence(contrast=60)
    inside = cv2.erode(flicker.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert np.abs(np.stack([found.of_frame(k)[inside] for k in range(T)])).mean() < 0.01


def test_pictures_of_a_long_clip_are_held_a_block_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of five frames in blocks of one, each seen with those up to two frames away, where its flow is not sure."""
    frames, pixels, known = clip(60), tiles(), flow_columns()
    near = np.abs(known["source"] - known["target"]) == 1
    unsure = np.zeros_like(known["confidence"][near])
    pairs = FlowPairs(Dense({name: values[near] for name, values in known.items()} | {"confidence": unsure}))
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()

    def found(asked: list[int]) -> np.ndarray:
        shown = belonging(pixels, pairs, lambda k: asked.append(k) or frames[k], static_world(), sure)
        return np.concatenate([shown.weight, shown.pixels.ravel()])

    asked: list[int] = []
    monkeypatch.setattr(layers, "DISTANCES", (1, 2))
    monkeypatch.setattr(uncovered, "DISTANCES", (1, 2))
    whole = found([])
    monkeypatch.setattr(flow_pairs, "BLOCK", 1)
    monkeypatch.setattr(layers, "REACH", 1)
    np.testing.assert_array_equal(found(asked), whole)
    assert sorted(asked) == sorted(j for k in range(T) for j in range(k - 2, k + 3) if 0 <= j < T)


def test_where_nothing_is_known_to_move_there_is_no_evidence() -> None:
    frames = clip(60)
    pixels = tiles()
    pairs = FlowPairs(Dense(flow_columns()))
    found = belonging(pixels, pairs, lambda k: frames[k], static_world(), np.full(len(pixels.areas), 0.4))
    assert (found.weight == 0).all()
    assert (found.pixels == 0).all()


def test_a_mover_is_not_lost_by_what_the_pictures_add_to_it() -> None:
    """Where they add much whose flow is unsure, the mean evidence of its flow falls."""
    frames, pixels, columns = clip(60), tiles(), flow_columns()
    known = [square(k) & (np.arange(W) < 144 + MOVER_PX * k) for k in range(T)]
    sure = [np.where(known[k], 0.3, np.where(square(k), 0.03, 0.6)) for k in range(T)]
    for e, i in enumerate(columns["source"]):
        columns["confidence"][e][square(i) & ~known[i]] = 0
    prior, confidence = pixels.means(np.stack(known).astype(float)), pixels.means(np.stack(sure))
    given = pixels, columns, prior, confidence, 1.0, 0.4
    before, _ = persistent(*given)
    pairs = FlowPairs(Dense(columns))
    shown = belonging(pixels, pairs, lambda k: frames[k], static_world(), before)
    after, instance = persistent(*given, None, shown.weight)
    found = [pixels.paint(of, 2) >= 0.5 for of in (before, after)]
    assert instance.max() == 1
    assert (found[1] & square(2)).sum() > 1.3 * (found[0] & square(2)).sum() > 0


def test_a_logo_beside_a_mover_is_no_part_of_it() -> None:
    """What is burnt in rests in the image, and so fits no motion of the scene."""
    logo = np.zeros((H, W), bool)
    logo[36:60, 88:104] = True
    frames = clip(60)
    frames[:, logo] = cv2.GaussianBlur(np.random.default_rng(5).integers(0, 255, (H, W, 3), np.uint8), (0, 0), 1)[logo]
    columns, pixels = flow_columns(), tiles()
    columns["flow"][:, logo] = 0
    pairs = FlowPairs(Dense(columns), scene=~logo)
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()
    weight = belonging(pixels, pairs, lambda k: frames[k], static_world(), sure).weight
    for k in range(T):
        shown = pixels.paint(weight, k)
        assert (shown[inner(logo)] == 0).all()
        around = cv2.dilate(logo.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
        assert shown[around & inner(~square(k))].max() < 0.1 * MOVING


def test_cameras_of_the_round_before_make_a_mover_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its flow, on half the size of the frames, is known in its left part alone; the pictures show the rest."""
    folder = tmp_path / "clip"
    frames = clip(60)
    for k, rgb in enumerate(frames):
        write_image(folder / f"frame_{k + 1:04d}.png", cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", folder)))
    columns = flow_columns()
    write_dense(tmp_path / "pairs.arrow", columns, {"width": W, "height": H, "scale": 0.5})
    known = np.stack([left_part(k) for k in range(T)]).astype(np.float16)
    evidence = {"frame": np.arange(1, T + 1), "probability": known, "weight": np.ones_like(known)}
    write_dense(tmp_path / "prior.arrow", evidence)
    cameras = static_cameras()
    write_cameras(tmp_path / "poses.parquet", replace(cameras, Ks=scale_intrinsics(cameras.Ks, 2)))
    cells = {"inverse_depth": np.ones((T, H // 4, W // 4), np.float32)}
    write_dense(tmp_path / "depth.arrow", cells, {"stride_px": 8.0})

    def overlaps(*previous: Path) -> list[float]:
        inputs = tmp_path / "sequence.json", tmp_path / "masks", tmp_path / "segment.png", SegmentOptions()
        segment_stage.main(*inputs, tmp_path / "pairs.arrow", tmp_path / "prior.arrow", *previous)
        masks = [read_mask(tmp_path / f"masks/frame_{k + 1:04d}.png") for k in range(T)]
        found = [(mask[::2, ::2], square(k)) for k, mask in enumerate(masks)]
        return [(mask & mover).sum() / (mask | mover).sum() for mask, mover in found]

    alone, together = overlaps(), overlaps(tmp_path / "poses.parquet", tmp_path / "depth.arrow")
    assert min(np.subtract(together, alone)) > 0.02
    assert np.mean(together) > np.mean(alone) + 0.05
    with monkeypatch.context() as patch:
        patch.setattr(refinement, "SHOWN_WEIGHT", 0.0)
        blunt = overlaps(tmp_path / "poses.parquet", tmp_path / "depth.arrow")
    assert np.mean(together) > np.mean(blunt) + 0.02, "borders follow what single pixels show"
    asked, of_frame = [], Belonging.of_frame
    with monkeypatch.context() as patch:
        patch.setattr(Belonging, "of_frame", lambda shown, k: asked.append(k) or of_frame(shown, k))
        overlaps(tmp_path / "poses.parquet", tmp_path / "depth.arrow")
    assert sorted(asked) == list(range(T)), "each frame's mask goes by the pixels of that frame"
    with pytest.raises(InputError, match="together with --previous-depth"):
        overlaps(tmp_path / "poses.parquet")
    lost = replace(cameras, status=np.full(T, "failed", object))
    write_cameras(tmp_path / "poses.parquet", lost)
    assert overlaps(tmp_path / "poses.parquet", tmp_path / "depth.arrow") == alone
