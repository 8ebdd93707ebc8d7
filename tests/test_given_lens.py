"""A lens off the centre with pixels that are not square, after the poses: motion, lifted points, renders."""

import export_clip as clip
import numpy as np
import torch
from synthetic import OFFSETS, flow_arrays, make_scene

from stages.gaussians.lifting import lift
from stages.gaussians.training_frames import TrainingFrames
from stages.motion import resweep
from stages.shared.artifacts import Dense
from stages.shared.cameras import intrinsics, project
from stages.shared.flow_pairs import FlowPairs

OFF_CENTRE = intrinsics(86.4, 1.15 * 86.4, 47.5 + 0.12 * 96, 31.5 - 4)


def test_a_static_scene_fits_its_depth_exactly() -> None:
    """Taken as centred and square, the same flow would not."""
    scene = make_scene(T=4, K=OFF_CENTRE)
    source, target, flow, weights = flow_arrays(scene, OFFSETS)
    pairs = FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": weights}))
    start = np.full(scene.depth.shape, 0.3, np.float32)
    worst = []
    for K in (scene.K, intrinsics(86.4, 86.4, 47.5, 31.5)):
        Ks = np.broadcast_to(K, (scene.T, 3, 3))
        evidence, _, _ = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, start)
        worst.append(np.percentile(evidence.residual[evidence.weight > 1], 90))
    assert worst[0] < 1e-3 < 0.1 < worst[1]


def test_lifted_points_return_to_their_pixels() -> None:
    scene = make_scene(T=2, K=OFF_CENTRE)
    images = np.random.default_rng(0).random((2, *scene.depth.shape[1:], 3)).astype(np.float32)
    Ks = np.broadcast_to(scene.K, (2, 3, 3))
    depths, still = scene.depth.astype(np.float32), np.zeros(scene.depth.shape, bool)
    seen = TrainingFrames(images, still, depths, still, scene.cam_from_world, Ks, np.arange(2.0))
    points = lift(seen, 1, np.ones(scene.depth.shape[1:], bool), 3)
    uv, _ = project(points.positions, scene.cam_from_world[1], scene.K)
    pixels = np.rint(uv).astype(int)
    assert np.abs(uv - pixels).max() < 1e-3
    np.testing.assert_array_equal(points.colours, images[1, pixels[:, 1], pixels[:, 0]])


def test_a_cropped_and_stretched_lens_renders_the_cropped_and_stretched_image() -> None:
    scene, viewmat = clip.scene(), torch.tensor(clip.CAM_FROM_WORLD[2])

    def render(K: np.ndarray, width: int, height: int) -> np.ndarray:
        with torch.no_grad():
            image: np.ndarray = scene.render(0.3, viewmat, torch.tensor(K), width, height).colour[0].numpy()
        return image

    whole = render(clip.K, clip.W, clip.H)
    cropped = clip.K - [[0, 0, 20], [0, 0, 6], [0, 0, 0]]
    assert np.abs(render(cropped, 60, 50) - whole[6:56, 20:80]).mean() < 1e-3
    doubled = clip.K * [[1], [2], [1]] + [[0, 0, 0], [0, 0, 0.5], [0, 0, 0]]
    stretched = render(doubled, clip.W, 2 * clip.H).reshape(clip.H, 2, clip.W, 3).mean(axis=1)
    assert np.abs(stretched - whole).mean() < 0.02
