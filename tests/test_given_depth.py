"""Depth that the user hands in: formats, unknown pixels, scale, and the comparison with measured depth."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.ba import given_depth
from stages.ba.depth import DepthMaps
from stages.ba.from_truth import resample, true_depth_maps
from stages.given.depth import open_depths
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.sequences import Sequence, check_sequence

T, H, W, STRIDE = 4, 48, 64, 2
UNIT = 3.0
"""Length of the truth per length in the gauge of the adjustment."""


def true_depth() -> np.ndarray:
    """Depth [T, H, W] of a slanted ground with a box on it; sky above."""
    v, u = np.mgrid[:H, :W]
    depth = np.stack([40.0 / np.maximum(v - 5 + 0.5 * k, 0.5) for k in range(T)])
    depth[:, 25:35, 20:40] = 1.2
    depth[:, :8] = np.inf
    return depth * (1 + 0.001 * u)


@pytest.fixture
def frames(tmp_path: Path) -> Sequence:
    """Four frames with true depth beside them, written from the description of MPI-Sintel's format."""
    folder, truth = tmp_path / "training/final/clip", tmp_path / "training/depth/clip"
    folder.mkdir(parents=True)
    truth.mkdir(parents=True)
    for k, depth in enumerate(true_depth(), 1):
        write_image(folder / f"frame_{k:04d}.png", np.full((H, W, 3), 20 * k, np.uint8))
        content = b"PIEH" + struct.pack("<ii", W, H) + depth.astype("<f4").tobytes()
        (truth / f"frame_{k:04d}.dpt").write_bytes(content)
    return check_sequence("clip", folder)


def measured(noise: float = 0.02) -> DepthMaps:
    """What an adjustment measures: noisy, in its own scale, and nothing in the sky."""
    rng = np.random.default_rng(0)
    exact = on_grid()
    inverse = np.where(exact > 0, UNIT * exact, 1.0) * np.exp(noise * rng.standard_normal(exact.shape))
    return DepthMaps(inverse, (noise * inverse) ** 2, exact == 0)


def on_grid() -> np.ndarray:
    """The true inverse depth on the grid of the adjustment."""
    return np.stack([resample(1 / depth, (H // STRIDE, W // STRIDE), STRIDE) for depth in true_depth()])


def write(folder: Path, write_one: Callable[[Path, np.ndarray], None], suffix: str, depth: np.ndarray) -> Path:
    """A folder of depth maps, numbered from 1."""
    folder.mkdir()
    for k, of_frame in enumerate(depth, 1):
        write_one(folder / f"{k:05d}{suffix}", of_frame)
    return folder


def as_png(scale: float) -> Callable[[Path, np.ndarray], None]:
    """The writer of 16-bit PNG; 0 where depth is not finite."""
    return lambda path, depth: Image.fromarray(
        np.where(np.isfinite(depth), depth / scale, 0).round().astype(np.uint16)
    ).save(path)


@pytest.mark.parametrize("scale", [1 / 256, 0.001])
def test_sixteen_bits_are_read_by_their_scale(tmp_path: Path, frames: Sequence, scale: float) -> None:
    folder = write(tmp_path / "depth", as_png(scale), ".png", true_depth())
    with pytest.raises(InputError, match=r"scale.json or depth.json beside.*0.00390625 for KITTI.*0.001 for millim"):
        open_depths(folder, frames)
    (folder / "depth.json").write_text(json.dumps({"scale": scale}))
    inverse = open_depths(folder, frames).inverse(1)
    assert np.isnan(inverse[:8]).all()
    assert 1 / inverse[8:] == pytest.approx(true_depth()[1, 8:], abs=0.51 * scale)


def test_arrays_are_read_with_what_is_unknown_far_or_unsure(tmp_path: Path, frames: Sequence) -> None:
    depth = true_depth()
    depth[:, 40, :3] = 0, -1, np.nan
    folder = write(tmp_path / "depth", lambda path, of: np.save(path, of[None].astype(np.float32)), ".npy", depth)
    sure = np.full((H, W), 255, np.uint8)
    sure[45:] = 100
    Image.fromarray(sure).save(folder / "00002.confidence.png")
    first, second = (open_depths(folder, frames).inverse(k) for k in (0, 1))
    assert np.all(first[:8] == 0)
    assert np.isnan(first).sum() == 3
    assert np.isnan(second[45:]).all()
    assert 1 / second[8:40] == pytest.approx(depth[1, 8:40], rel=1e-6)


def test_given_true_depth_is_the_truth(frames: Sequence) -> None:
    """In the scale of the adjustment, found from noisy estimates."""
    true = true_depth_maps(frames, measured(), STRIDE, None)
    given, told = given_depth.given_depth_maps(frames, frames.truth["depth"][1].parent, measured(), STRIDE, None)
    assert given.inverse_depth == pytest.approx(true.inverse_depth, rel=5e-3)
    assert not given.filled.any()
    assert np.sqrt(np.median(given.variance / given.inverse_depth**2)) == pytest.approx(0.02, rel=0.3)
    assert told.startswith("100% of the pixels, scale 3, spread 2.0 %")


def test_unknown_pixels_keep_the_estimate(tmp_path: Path, frames: Sequence) -> None:
    depth = 7 * true_depth()
    depth[:, :, : W // 2] = 0
    folder = write(tmp_path / "depth", np.save, ".npy", depth)
    estimated = measured()
    given, told = given_depth.given_depth_maps(frames, folder, estimated, STRIDE, None)
    left, right = np.s_[:, :, : W // 2 // STRIDE], np.s_[:, 4:, W // 2 // STRIDE :]
    assert np.array_equal(given.inverse_depth[left], estimated.inverse_depth[left])
    assert np.array_equal(given.filled[left], estimated.filled[left])
    assert given.inverse_depth[right] == pytest.approx(UNIT * on_grid()[right], rel=0.03)
    assert told.startswith("50% of the pixels, scale 21, spread 2.0 %")


@pytest.mark.parametrize("reverse", [lambda depth: 1 / depth, lambda depth: 0.3 + 2 / depth])
def test_disparity_is_recognised(tmp_path: Path, frames: Sequence, reverse: Callable[[np.ndarray], np.ndarray]) -> None:
    """Scaled, or scaled and shifted, as networks for single images give it."""
    folder = write(tmp_path / "depth", np.save, ".npy", reverse(true_depth()))
    with pytest.raises(InputError, match=r"z-depth, larger where farther.*rank correlation -1.00 .*this is disparity"):
        given_depth.given_depth_maps(frames, folder, measured(), STRIDE, None)


def test_depth_of_other_frames_is_refused(tmp_path: Path, frames: Sequence) -> None:
    rng = np.random.default_rng(1)
    folder = write(tmp_path / "depth", np.save, ".npy", np.exp(rng.standard_normal((T, H, W))))
    with pytest.raises(InputError, match=r"agrees with what the adjustment has measured, found a spread of \d+%"):
        given_depth.given_depth_maps(frames, folder, measured(), STRIDE, None)


def test_a_wall_of_one_depth_needs_no_order() -> None:
    rng = np.random.default_rng(0)
    wall = DepthMaps(
        1 + 0.005 * rng.standard_normal((T, 20, 20)), np.full((T, 20, 20), 1e-4), np.zeros((T, 20, 20), bool)
    )
    found = given_depth.agreement(np.full((T, 20, 20), 0.25), wall)
    assert found is not None
    given_depth.refuse_disagreement(found, Path("depth"), None)
    assert found.scale == pytest.approx(4, rel=0.01)


def test_fixed_poses_fix_the_scale(frames: Sequence) -> None:
    folder = frames.truth["depth"][1].parent
    exact, _ = given_depth.given_depth_maps(frames, folder, measured(), STRIDE, 1.02 / UNIT)
    assert exact.inverse_depth[:, 10:] == pytest.approx(UNIT / 1.02 * on_grid()[:, 10:], rel=1e-6)
    with pytest.raises(InputError, match=r"scale of the fixed poses, found depth 2 times as large; divide it by 1.99"):
        given_depth.given_depth_maps(frames, folder, measured(), STRIDE, 2 / UNIT)


def test_a_camera_that_found_no_depth_takes_it_in_units_of_its_median(frames: Sequence) -> None:
    shape = (T, H // STRIDE, W // STRIDE)
    nothing = DepthMaps(np.ones(shape), np.ones(shape), np.ones(shape, bool))
    given, told = given_depth.given_depth_maps(frames, frames.truth["depth"][1].parent, nothing, STRIDE, None)
    assert "not compared" in told
    assert np.median(given.inverse_depth[:, 4:]) == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda f: write(f, np.save, ".npy", true_depth()[:, ::2, ::2]), "64 x 48.*32 x 24, the frames scaled by 0.5"),
        (lambda f: write(f, np.save, ".npy", -true_depth()), "a depth above 0, found none"),
        (lambda f: write(f, np.save, ".npy", np.zeros((T, H, W, 3))), r"depth \[height, width\], found \[48, 64, 3\]"),
        (lambda f: write(f, np.save, ".npy", true_depth()[:2]), "depth maps for every frame, found 2 of 4"),
    ],
)
def test_wrong_maps_are_refused_in_one_line(
    tmp_path: Path, frames: Sequence, make: Callable[[Path], Path], said: str
) -> None:
    folder = make(tmp_path / "depth")
    with pytest.raises(InputError, match=said) as refused:
        given_depth.given_depth_maps(frames, folder, measured(), STRIDE, None)
    assert "\n" not in str(refused.value)


def test_two_formats_and_eight_bits_are_refused(tmp_path: Path, frames: Sequence) -> None:
    folder = write(tmp_path / "depth", np.save, ".npy", true_depth())
    Image.fromarray(np.zeros((H, W), np.uint8)).save(folder / "00001.png")
    with pytest.raises(InputError, match=r"one format, found .npy and .png"):
        open_depths(folder, frames)
    for path in folder.glob("*.npy"):
        Image.fromarray(np.zeros((H, W), np.uint8)).save(path.with_suffix(".png"))
        path.unlink()
    (folder / "depth.json").write_text('{"scale": 0.01}')
    with pytest.raises(InputError, match="16-bit grey PNG of depth, found uint8"):
        open_depths(folder, frames).inverse(0)
