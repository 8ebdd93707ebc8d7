"""The motion prior against exact scenes: two-view geometry, the depth re-sweep, and pooling."""

import cv2
import numpy as np
import pytest
from synthetic import Scene, flow_arrays, make_scene, painted

from stages.motion import __main__ as motion_stage
from stages.motion import epipolar, photometric, pooling, resweep
from stages.motion.epipolar import Evidence
from stages.shared import flow_pairs as flow_pairs_module
from stages.shared import lie
from stages.shared.artifacts import Dense
from stages.shared.cameras import pixel_grid, projection, static_flow
from stages.shared.flow_pairs import FlowPairs
from stages.shared.static_flow import Z_MIN, dense_static_flow, resample


def observed(scene: Scene) -> FlowPairs:
    """Exact flow of a scene as the motion stage reads it."""
    return flow_pairs(*flow_arrays(scene))


def flow_pairs(source: np.ndarray, target: np.ndarray, flow: np.ndarray, confidence: np.ndarray) -> FlowPairs:
    """Flow [E, h, w, 2] of edges, and its confidence [E, h, w]."""
    return FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": confidence}))


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / (found | truth).sum())


def test_sampson_error_is_the_distance_to_the_nearest_true_match() -> None:
    """Against the optimal correction of Hartley and Sturm, for small errors."""
    rng = np.random.default_rng(0)
    F = lie.skew(np.array([0.9, 0.1, 0.3])) @ lie.exp_so3(np.array([0.02, -0.05, 0.01]))
    x, y = rng.uniform(-0.5, 0.5, (50, 2)), rng.uniform(-0.5, 0.5, (50, 2))
    x_true, y_true = cv2.correctMatches(F, x[None], y[None])
    x, y = x_true[0] + 1e-5 * rng.normal(size=x.shape), y_true[0] + 1e-5 * rng.normal(size=y.shape)
    x_near, y_near = cv2.correctMatches(F, x[None], y[None])
    distance = np.sqrt(((x_near[0] - x) ** 2).sum(axis=1) + ((y_near[0] - y) ** 2).sum(axis=1))
    np.testing.assert_allclose(epipolar.epipolar_errors(F, x, y), distance, rtol=1e-2, atol=1e-8)


def test_a_mover_stands_out_without_cameras() -> None:
    """A block that moves across the epipolar lines; motion along them is beyond two views."""
    scene = make_scene(T=5, size=(128, 192))
    pairs = observed(scene)
    moving = np.zeros(scene.depth.shape, bool)
    moving[:, 40:80, 60:110] = True
    steps = (pairs.target - pairs.source)[:, None, None, None]
    pairs.columns["flow"] = pairs.flow + moving[0][..., None] * steps * np.array([0, 3], np.float32)
    assert epipolar.flat_share(pairs, 0) < epipolar.FLAT_SHARE
    evidence = epipolar.two_view_evidence(pairs, scene.T, parallax=True, seed=0)
    residual = pooling.pool(evidence, painted(moving), pairs)
    probability = motion_stage.to_probability(residual, *motion_stage.FLOW_CURVE)
    assert overlap(probability > 0.5, moving) > 0.6


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges and frames are worked on side by side: their sums must not depend on how many at once."""
    scene = make_scene(T=5, size=(64, 96), disc_radius=0.5)
    pairs = observed(scene)
    found = []
    for threads in ("1", "4"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        evidence = epipolar.two_view_evidence(pairs, scene.T, parallax=True, seed=0)
        residual = pooling.pool(evidence, painted(scene.dynamic), pairs)
        found.append([*evidence, residual])
    for alone, together in zip(*found, strict=True):
        np.testing.assert_array_equal(alone, together)


def test_the_length_of_runs_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames at the ends of a run have neighbours in the next one."""
    scene = make_scene(T=7, size=(48, 64), disc_radius=0.5)
    pairs, Ks = observed(scene), np.broadcast_to(scene.K, (scene.T, 3, 3))
    rgb, start = painted(scene.dynamic), np.full(scene.depth.shape, 0.2, np.float32)
    found = []
    for frames in (1, 3, 16):
        monkeypatch.setattr(flow_pairs_module, "BLOCK", frames)
        flat = epipolar.two_view_evidence(pairs, scene.T, parallax=True, seed=0)
        evidence, inverse_depth, _ = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, start)
        lines = resweep.projections(pairs, scene.cam_from_world, Ks)
        sure, passing = photometric.corroborate(evidence, rgb, pairs, lines, inverse_depth)
        found.append([*flat, *evidence, inverse_depth, *sure, passing, pooling.pool(sure, rgb, pairs)])
    for one, three, sixteen in zip(*found, strict=True):
        np.testing.assert_array_equal(one, sixteen)
        np.testing.assert_array_equal(three, sixteen)


def test_places_seen_again_are_no_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong flow over more than REACH frames changes no residual, scale or reliability."""
    scene = make_scene(T=6, size=(48, 64), disc_radius=0.5)
    source, target, flow, confidence = flow_arrays(scene)
    far = np.abs(source - target) == 3
    for module in (epipolar, resweep, flow_pairs_module, photometric):
        monkeypatch.setattr(module, "REACH", 2)
    wrong = flow + far[:, None, None, None] * np.float32(4)
    rgb, start = painted(scene.dynamic), np.full(scene.depth.shape, 0.2, np.float32)
    Ks, found = np.broadcast_to(scene.K, (scene.T, 3, 3)), []
    for pairs in (
        flow_pairs(source, target, wrong, np.where(far[:, None, None], 0.9, confidence).astype(np.float32)),
        flow_pairs(source[~far], target[~far], flow[~far], confidence[~far]),
    ):
        flat = epipolar.two_view_evidence(pairs, scene.T, parallax=True, seed=0)
        evidence, inverse_depth, sigma_px = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, start)
        lines = resweep.projections(pairs, scene.cam_from_world, Ks)
        sure, _ = photometric.corroborate(evidence, rgb, pairs, lines, inverse_depth)
        found.append([*flat, *evidence, inverse_depth, np.array(sigma_px), *sure])
    for with_loops, without in zip(*found, strict=True):
        np.testing.assert_allclose(with_loops, without, atol=1e-6)


def test_a_mover_stands_out_sharply_with_cameras() -> None:
    scene = make_scene(disc_radius=0.5)
    pairs = observed(scene)
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    evidence, _, _ = resweep.camera_evidence(
        pairs, scene.cam_from_world, Ks, np.full(scene.depth.shape, 0.2, np.float32)
    )
    residual = pooling.pool(evidence, painted(scene.dynamic), pairs)
    assert overlap(motion_stage.to_probability(residual, *motion_stage.CAMERA_CURVE) > 0.5, scene.dynamic) > 0.7


def test_static_scene_fits_its_depth_exactly() -> None:
    """The re-sweep starts from a wrong constant and must find the true depth of every pixel that shows parallax."""
    scene = make_scene(T=5)
    pairs = observed(scene)
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    start = np.full(scene.depth.shape, 0.3, np.float32)
    evidence, _, sigma_px = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, start)
    assert sigma_px == pytest.approx(resweep.SIGMA_RANGE_PX[0])
    assert evidence.residual[evidence.weight > 1].max() < 1e-3


@pytest.mark.parametrize(("share", "found"), [(0.6, False), (-0.5, False), (-1.6, True)])
def test_a_mover_parallel_to_the_camera_fits_a_static_depth(share: float, found: bool) -> None:
    """It moves by -share of the camera's motion: at its depth over 1 + share it fits exactly, if that is positive."""
    velocity = make_scene(T=1, disc_radius=0.5).velocity
    time = np.arange(6)[:, None]
    path = lie.exp_se3(time * np.array([0, 0, 0, 0.003, -0.012, 0.002]))
    centres = -time * velocity / share
    path[:, :3, 3] = (path[:, :3, :3] @ -centres[..., None])[..., 0]
    scene = make_scene(T=6, disc_radius=0.5, path=path)
    start = np.full(scene.depth.shape, 0.3, np.float32)
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    evidence, inverse_depth, _ = resweep.camera_evidence(observed(scene), path, Ks, start)
    mover = scene.dynamic & (evidence.weight > 1)
    if found:
        assert np.median(evidence.residual[mover]) > 0.5
    else:
        assert evidence.residual[mover].max() < 1e-3
        np.testing.assert_allclose((inverse_depth * scene.depth)[mover], 1 + share, rtol=1e-2)


def test_sweep_is_as_good_as_trying_every_depth() -> None:
    """Brute force in numpy over 4000 inverse depths, on noisy flow with a mover, finds nothing much better."""
    scene = make_scene(T=4, size=(16, 24), disc_radius=0.6)
    pairs = observed(scene)
    flow = pairs.flow + 0.3 * np.random.default_rng(1).standard_normal(pairs.flow.shape).astype(np.float32)
    i, j = pairs.source, pairs.target
    relative = scene.cam_from_world[j] @ lie.inverse(scene.cam_from_world[i])
    A = scene.K @ relative[:, :3, :3] @ np.linalg.inv(scene.K)
    b = (scene.K @ relative[:, :3, 3:])[..., 0]
    pointer = np.searchsorted(i, np.arange(scene.T + 1))
    start = np.full(scene.depth.shape, 0.3, np.float32)
    weights = np.stack([pairs.weights(e) for e in range(len(flow))])
    residual, inverse_depth = resweep.sweep(pointer, A, b, flow, weights, start, 0.5, 1)
    reference, at_found = brute_force(scene, A, b, flow, pairs, inverse_depth, 0.5)
    np.testing.assert_allclose(residual, at_found, atol=1e-4)
    assert np.quantile(residual - reference, 0.95) < 0.05


def brute_force(
    scene: Scene,
    A: np.ndarray,
    b: np.ndarray,
    flow: np.ndarray,
    pairs: FlowPairs,
    found: np.ndarray,
    sigma_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest residual per pixel over a fine grid of inverse depths, and the residual at those found."""
    pixels = pixel_grid(*scene.depth.shape[1:])
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)

    def residual(d: np.ndarray) -> np.ndarray:
        cost, total = np.zeros(scene.depth.shape), np.zeros(scene.depth.shape)
        for e, i in enumerate(pairs.source):
            there = homogeneous @ A[e].T + d[i][..., None] * b[e]
            behind = there[..., 2] < Z_MIN
            z = np.where(behind, 1.0, there[..., 2])
            q = ((pixels + flow[e] - there[..., :2] / z[..., None]) ** 2).sum(axis=-1) / sigma_px**2
            cost[i] += pairs.weights(e) * np.where(behind, 1.0, q / (1 + q))
            total[i] += pairs.weights(e)
        return cost / np.maximum(total, 1e-12)

    grid = np.concatenate([[0], np.geomspace(1e-3, resweep.D_MAX, 4000)])
    best = np.min([residual(np.full(scene.depth.shape, d)) for d in grid], axis=0)
    return best, residual(found.astype(float))


def test_the_kernel_of_static_flow_equals_the_formula() -> None:
    rng = np.random.default_rng(0)
    K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
    moved = lie.exp_se3(np.array([0.3, -0.1, 0.5, 0.05, -0.1, 0.02]))
    A, b = projection((np.eye(4), K), (moved, K))
    inverse_depth = rng.uniform(0, 0.8, (64, 96)).astype(np.float32)
    expected, ratio = static_flow(pixel_grid(64, 96), inverse_depth, A, b)
    assert ratio.min() > Z_MIN
    np.testing.assert_allclose(dense_static_flow(A, b, inverse_depth), expected, atol=2e-4)


def test_depth_is_resampled_where_its_cells_lie() -> None:
    """A ramp stays that ramp: cell k of s px is centred at s k + (s - 1) / 2."""
    ramp = np.broadcast_to(8 * np.arange(12) + 3.5, (1, 6, 12)).astype(np.float32)
    fine = resample(ramp, 8.0, 48, 96)
    np.testing.assert_allclose(fine[0, 20, 4:90], np.arange(4, 90), atol=0.2)


def test_pooling_fills_from_neighbouring_frames() -> None:
    """A pixel unseen in one frame takes the evidence that the flow brings from the next ones."""
    residual, weight = np.zeros((3, 20, 20), np.float32), np.ones((3, 20, 20), np.float32)
    residual[1:, 5:15, 5:15] = 1.0
    weight[0] = 0
    flow, confidence = np.zeros((2, 20, 20, 2), np.float32), np.ones((2, 20, 20), np.float32)
    pairs = flow_pairs(np.array([0, 0]), np.array([1, 2]), flow, confidence)
    pooled = pooling.pool(Evidence(residual, weight), painted(residual > 0), pairs)
    assert pooled[0, 10, 10] > 0.8
    assert pooled[0, 1, 1] < 1e-6


def test_evidence_speaks_for_pixels_alike_up_to_a_colour_edge() -> None:
    """Half of a mover is matched; the other half, and what stands beside it, say nothing themselves."""
    moving = np.zeros((1, 40, 128), bool)
    moving[:, :, 60:68] = True
    residual, weight = moving.astype(np.float32), np.zeros(moving.shape, np.float32)
    weight[:, :20, 60:68] = 5.0
    none = np.zeros(0, int)
    pairs = flow_pairs(none, none, np.zeros((0, 40, 128, 2), np.float32), np.zeros((0, 40, 128), np.float32))
    pooled = pooling.pool(Evidence(residual, weight), painted(moving), pairs)
    assert pooled[0, 22, 62:66].min() > 0.5
    assert pooled[0, :, 56:59].max() < 0.01


def test_badly_matched_flow_weighs_little_and_flow_out_of_the_frame_nothing() -> None:
    flow = np.zeros((1, 20, 20, 2), np.float32)
    flow[0, :, 15:] = (10, 0)
    confidence = np.ones((1, 20, 20), np.float32)
    confidence[0, :5] = 0
    weights = flow_pairs(np.array([0]), np.array([1]), flow, confidence).weights(0)
    assert 0 < weights[0, 0] < 0.1
    assert (weights[:, 15:] == 0).all()
    assert weights[10, 5] == 1
