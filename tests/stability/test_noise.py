"""Hard cases of noise: texture that it hides, frames that must not be averaged, nothing but noise."""

from pathlib import Path

import cv2
import numpy as np

from stages.flow import noise
from stages.flow.averaging import to_match
from stages.flow.dis import estimate_flow
from stages.flow.edges import Edge, edge_list
from stages.flow.estimate import Estimate
from stages.flow.frames import Images
from stages.flow.options import FlowOptions

SIGMA, STEP_PX = 6.0, 1.5


def dim_frames(T: int, sigma: float, contrast: float = 3.0) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 of faint texture that moves by STEP_PX per frame to the right, under noise."""
    rng = np.random.default_rng(0)
    wide = sum(cv2.GaussianBlur(rng.standard_normal((112, 224)), (0, 0), s) * s for s in (2.5, 6))
    wide = 60 + contrast * (wide / wide.std())
    frames = []
    for k in range(T):
        shift = np.array([[1, 0, k * STEP_PX - 24], [0, 1, -8]], np.float32)
        moved = cv2.warpAffine(wide, shift, (176, 96), flags=cv2.INTER_CUBIC)[..., None]
        frames.append(moved + sigma * rng.standard_normal((96, 176, 3)))
    return np.clip(np.stack(frames), 0, 255).round().astype(np.uint8)


def matched(
    folder: Path, rgb: np.ndarray, options: FlowOptions
) -> tuple[dict[Edge, np.ndarray], dict[Edge, np.ndarray], bool]:
    """Flow and confidence of the near edges of frames, and whether the frames were averaged."""
    frames = to_match(Images(len(rgb), lambda k: rgb[k]), options.finest_scale, 1, folder)
    matcher = Estimate(frames, options.offsets, {}, 1)
    flow, _ = matcher.near(edge_list(len(rgb), options.offsets), {})
    return flow, {edge: matcher.confidence(edge, flow) for edge in flow}, frames.averaged


def test_averaging_finds_flow_that_noise_hides(tmp_path: Path) -> None:
    """Faint texture, twice as loud a noise: plain search errs by more, and its frames give little to trust."""
    rgb = dim_frames(7, SIGMA)
    options = FlowOptions(offsets=(1,), long_edges=0)
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb])
    plain = estimate_flow(grey, edge_list(7, (1,)), 0, 1)
    found, confidence, averaged = matched(tmp_path, rgb, options)

    def error(flow: np.ndarray) -> np.ndarray:
        return np.linalg.norm(flow - (STEP_PX, 0), axis=-1)[8:-8, 8:-8]

    edges = [(k, k + 1) for k in range(6)]
    errors = [np.mean([error(flow[edge]) for edge in edges]) for flow in (plain, found)]
    assert averaged
    assert errors[1] < 0.8 * errors[0]
    sure = np.stack([confidence[edge][8:-8, 8:-8] > 0.5 for edge in edges])
    right = np.stack([error(found[edge]) < 1 for edge in edges])
    assert sure.mean() > 0.6
    assert right[sure].mean() > 0.9


def test_clear_and_textureless_frames_are_left_alone() -> None:
    """By day nothing is averaged, nor where there is no texture but no noise that hides it either."""
    clear = dim_frames(3, 1.0, contrast=30.0)
    flat = np.full((3, 48, 64, 3), 90, np.uint8)
    for rgb in (clear, flat):
        grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb])
        assert not noise.hides_texture(grey, [noise.flow_variance(frame) for frame in grey])


def test_what_is_hidden_in_the_neighbours_is_not_averaged_away() -> None:
    """Along wrong flow a bright square would become a ghost of itself; noise alone falls as the mean of five does."""
    rng = np.random.default_rng(0)
    still = np.full((5, 96, 160), 60.0, np.float32)
    still[2, 40:56, 70:90] += 40
    grey = (still + 4 * rng.standard_normal(still.shape)).astype(np.float32)
    nowhere = np.zeros((96, 160, 2), np.float32)
    mean, left = noise.averaged(grey, {(2, j): nowhere for j in (0, 1, 3, 4)}, 2, 16.0)
    background = np.s_[:30]
    assert abs(mean[42:54, 72:88].mean() - 100) < 2
    assert left[42:54, 72:88].min() > 0.9 * 16
    assert np.median(left[background]) < 0.3 * 16
    assert mean[background].std() ** 2 < 0.4 * 16


def test_nothing_but_noise_is_nowhere_trusted(tmp_path: Path) -> None:
    """Averaged frames share their noise, so that their flow agrees with itself both ways."""
    rgb = dim_frames(5, SIGMA, contrast=0.0)
    _, confidence, averaged = matched(tmp_path, rgb, FlowOptions(offsets=(1, 2), long_edges=0))
    assert averaged
    assert np.mean([values > 0.5 for values in confidence.values()]) < 0.01
