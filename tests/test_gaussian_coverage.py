"""Static Gaussians of long paths: lifted from as many frames as show something new, and from no more."""

import numpy as np
import pytest

from stages.gaussians.initial_cloud import cloud_within
from stages.gaussians.lifting import LIFTED_FRAMES
from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import pixels_of
from stages.shared.cameras import centred_intrinsics

W, H, DEPTH = 24, 16, 4.0
K = centred_intrinsics(24.0, W, H)
VIEW = DEPTH * W / 24.0
"""Width of the wall in view."""


def along_a_wall(places: np.ndarray) -> TrainingFrames:
    """Frames before a wall, from these places along it, in widths of the view."""
    F = len(places)
    poses = np.tile(np.eye(4), (F, 1, 1))
    poses[:, 0, 3] = -VIEW * places
    flat, no = np.ones((F, H, W), np.float32), np.zeros((F, H, W), bool)
    return TrainingFrames(
        flat[..., None].repeat(3, -1), no, DEPTH * flat, no, poses, np.tile(K, (F, 1, 1)), np.arange(F) / (F - 1)
    )


def lifted_from(seen: TrainingFrames, most: int = 100_000) -> tuple[float, int, int]:
    """The least share of a frame that Gaussians cover at their stride, their number, and the stride."""
    cloud, stride = cloud_within(seen, None, len(seen.images) // 2, 1, 4, 0, most)
    shares = []
    for f in range(len(seen.images)):
        u, v, _, inside = pixels_of(seen, f, cloud.means.double().numpy())
        shares.append(len(np.unique(H * u[inside] + v[inside])) * stride**2 / (W * H))
    return min(shares), len(cloud.means), stride


@pytest.mark.parametrize("widths", [0.5, 8.0, 24.0])
def test_a_path_of_any_length_has_no_holes(widths: float) -> None:
    """Nine frames of the longest path show a third of its wall."""
    covered, count, _ = lifted_from(along_a_wall(np.linspace(0, widths, 200)))
    assert covered > 0.8
    assert count < 1.15 * W * H * (1 + widths)  # what is covered is not lifted again


def test_a_camera_that_turns_round_between_two_lifted_frames_is_noticed() -> None:
    away = np.interp(np.arange(400), (0, 58, 71, 84, 399), (0, 0, 2, 0, 0))  # back at the middle between 57 and 114
    assert lifted_from(along_a_wall(away))[0] > 0.7


def test_a_short_clip_is_lifted_from_the_frames_of_the_order_alone() -> None:
    seen = along_a_wall(np.linspace(0, 0.06 * LIFTED_FRAMES, 10 * LIFTED_FRAMES))
    masks = np.zeros((len(seen.images), H, W), bool)
    images = np.zeros((len(seen.images), H, W, 3), np.float32)
    images += np.arange(len(images))[:, None, None, None] / 255
    seen = TrainingFrames(images, masks, seen.depths, masks, seen.cam_from_world, seen.Ks, seen.times)
    cloud, _ = cloud_within(seen, None, 40, 1, 4, 0, 100_000)
    assert len(np.unique(cloud.sh[:, 0, 0].numpy())) <= LIFTED_FRAMES + 1


def test_a_long_path_stays_within_the_largest_number_of_gaussians() -> None:
    covered, count, stride = lifted_from(along_a_wall(np.linspace(0, 40, 200)), most=3000)
    assert count <= 3000
    assert stride > 1
    assert covered > 0.6
