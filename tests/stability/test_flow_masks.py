"""Hard cases of flow, motion prior and masks: nothing to match, nothing that moves, everything that moves."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import PLANE, Scene, flow_arrays, make_scene, painted

from stages.flow.confidence import flow_confidence
from stages.flow.dis import estimate_flow
from stages.flow.edges import edge_list
from stages.motion import __main__ as motion_stage
from stages.motion import epipolar, photometric, pooling, resweep
from stages.motion.epipolar import Evidence
from stages.segment.options import SegmentOptions
from stages.segment.permanence import Links, confidence_of, persistent
from stages.segment.refinement import guarded_threshold, smooth_along_edges, to_mask
from stages.segment.superpixels import superpixels
from stages.shared import sintel
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import read_mask, read_rgb


def observed(scene: Scene) -> FlowPairs:
    """Exact flow of a scene."""
    return flow_pairs(*flow_arrays(scene))


def flow_pairs(source: np.ndarray, target: np.ndarray, flow: np.ndarray, confidence: np.ndarray) -> FlowPairs:
    """Flow [E, h, w, 2] of edges, and its confidence [E, h, w]."""
    return FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": confidence}))


def coloured(grey: np.ndarray) -> np.ndarray:
    """Grey frames [T, h, w] as colour frames."""
    return np.repeat(grey[..., None], 3, axis=-1)


def prior_with_cameras(scene: Scene, cam_from_world: np.ndarray | None = None) -> np.ndarray:
    """Probability of motion [T, h, w] from exact flow and cameras."""
    pairs = observed(scene)
    poses = scene.cam_from_world if cam_from_world is None else cam_from_world
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    start = np.full(scene.depth.shape, np.median(1 / scene.depth), np.float32)
    evidence, _, _ = resweep.camera_evidence(pairs, poses, Ks, start)
    residual = pooling.pool(evidence, painted(scene.dynamic), pairs)
    return motion_stage.to_probability(residual, *motion_stage.CAMERA_CURVE)


@pytest.mark.parametrize("grey_level", [0, 128, 255])
def test_textureless_and_saturated_frames_give_finite_still_flow(grey_level: int) -> None:
    """Normalising by a residual or a contrast of zero would give NaN."""
    frames = np.full((3, 48, 64), grey_level, np.uint8)
    flow = estimate_flow(frames, edge_list(3, (1,)), 0, threads=1)
    confidence = flow_confidence(flow[0, 1], flow[1, 0], frames[0], frames[1])
    assert np.abs(flow[0, 1]).max() < 0.1
    assert np.isfinite(confidence).all()
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_still_frames_have_no_parallax_and_no_motion() -> None:
    scene = make_scene(T=4, motion="still")
    pairs = observed(scene)
    pairs.columns["flow"] = np.zeros_like(pairs.flow)
    assert epipolar.flat_share(pairs, 0) == 1.0
    evidence = epipolar.two_view_evidence(pairs, scene.T, parallax=False, seed=0)
    assert evidence.residual.max() < 1e-3


@pytest.mark.parametrize(("motion_kind", "planes"), [("rotate", None), ("curve", PLANE)])
def test_rotation_and_planes_take_homographies(motion_kind: str, planes: tuple | None) -> None:
    """A fundamental matrix is undetermined there, and its epipole free to explain a mover away."""
    scene = make_scene(T=5, motion=motion_kind, **({"planes": planes} if planes else {}))
    pairs = observed(scene)
    assert epipolar.flat_share(pairs, 0) > 0.95
    evidence = epipolar.two_view_evidence(pairs, scene.T, parallax=False, seed=0)
    assert evidence.residual.max() < 0.01


def test_failed_flow_is_no_motion_unless_the_pictures_say_so() -> None:
    """A still square with wrong flow and a moving one, both without confidence, leave the same residual."""
    texture = np.random.default_rng(0).integers(0, 255, (64, 200), dtype=np.uint8)
    grey = np.stack([texture[:, 40 + 2 * k : 136 + 2 * k] for k in range(3)])
    failed, moving = np.s_[20:44, 12:36], np.s_[20:44, 56:80]
    edges = [(i, j) for i in range(3) for j in range(3) if i != j]
    flow = np.stack([np.full((64, 96, 2), (-2 * (j - i), 0), np.float32) for i, j in edges])
    confidence = np.ones(flow.shape[:3], np.float32)
    for e, (i, j) in enumerate(edges):
        for part in (failed, moving):
            flow[e][part], confidence[e][part] = (2 * (j - i), 0), 0
    for k in range(3):
        grey[k, 20:44, 54 + 2 * k : 82 + 2 * k] = texture[20:44, :28]
    source, target = np.array(edges).T
    pairs = flow_pairs(source, target, flow, confidence)
    projections = np.tile(np.eye(3), (len(edges), 1, 1)), (target - source)[:, None] * [-2.0, 0, 0]
    all_residual = Evidence(np.ones(grey.shape, np.float32), np.ones(grey.shape, np.float32))
    cut = photometric.corroborate(all_residual, coloured(grey), pairs, projections, np.ones(grey.shape))[0].residual
    assert cut[1][failed].mean() < 0.05
    assert cut[1][moving].mean() > 0.9
    assert (cut[1][:, 40:50] == 1).all()


def test_a_wrong_depth_beside_a_thin_thing_is_no_motion() -> None:
    """Distant frames gave a static strip the depth of what stands beside it; the depth around it fits the pictures."""
    texture = np.random.default_rng(1).integers(0, 255, (64, 200), dtype=np.uint8)
    grey = np.stack([texture[:, 40 + 2 * k : 136 + 2 * k] for k in range(3)])
    edges = [(i, j) for i in range(3) for j in range(3) if i != j]
    source, target = np.array(edges).T
    flow = np.stack([np.full((64, 96, 2), (-2 * (j - i), 0), np.float32) for i, j in edges])
    confidence, strip = np.ones(flow.shape[:3], np.float32), np.s_[:, 40:48]
    inverse_depth, residual = np.ones(grey.shape, np.float32), np.zeros(grey.shape, np.float32)
    confidence[:, :, 40:48], inverse_depth[:, :, 40:48], residual[:, :, 40:48] = 0, 2.5, 1
    pairs = flow_pairs(source, target, flow, confidence)
    projections = np.tile(np.eye(3), (len(edges), 1, 1)), (target - source)[:, None] * [-2.0, 0, 0]
    evidence = Evidence(residual, np.zeros(grey.shape, np.float32))
    cut, _ = photometric.corroborate(evidence, coloured(grey), pairs, projections, inverse_depth)
    assert cut.residual[1][strip].mean() < 0.05
    assert (cut.weight[1] > 0.5).all(), "what the pictures say counts without confident flow"


def test_motion_that_only_colour_shows_is_confirmed_where_all_is_matched_badly() -> None:
    """A red thing as bright as the green wall it passes, in frames without one confident match."""
    moving = np.zeros((3, 64, 96), bool)
    for k in range(3):
        moving[k, 20:44, 14 + 24 * k : 34 + 24 * k] = True
    rgb = np.where(moving[..., None], (200, 40, 40), (40, 121, 40)).astype(np.uint8)
    luminance = rgb @ np.array([0.299, 0.587, 0.114])
    assert np.ptp(luminance) < 1.0
    edges = [(i, j) for i in range(3) for j in range(3) if i != j]
    source, target = np.array(edges).T
    steps = (target - source)[:, None, None, None]
    flow = np.where(moving[source][..., None], steps * [24.0, 0], 0).astype(np.float32)
    pairs = flow_pairs(source, target, flow, np.zeros(flow.shape[:3], np.float32))
    projections = np.tile(np.eye(3), (len(edges), 1, 1)), np.zeros((len(edges), 3))
    evidence = Evidence(np.ones(moving.shape, np.float32), np.zeros(moving.shape, np.float32))
    found, _ = photometric.corroborate(evidence, rgb, pairs, projections, np.ones(moving.shape))
    assert found.residual[1, 24:40, 42:54].min() > 0.9
    assert found.residual[1, :, :30].max() < 0.05
    assert found.weight.min() >= pooling.PRIOR_WEIGHT


def test_pure_rotation_keeps_the_depth_it_starts_from() -> None:
    """Triangulating with no baseline divides nothing by nothing."""
    scene = make_scene(T=5, motion="rotate")
    pairs = observed(scene)
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    evidence, _, _ = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, np.ones(scene.depth.shape, np.float32))
    assert np.isfinite(evidence.residual).all()
    assert evidence.residual.max() < 1e-3


def test_wrong_cameras_cannot_hide_behind_no_flow() -> None:
    """Without one confident match the prior is static, not NaN."""
    scene = make_scene(T=4)
    pairs = observed(scene)
    pairs = pairs.counting(np.zeros(len(pairs.source), bool))
    Ks = np.broadcast_to(scene.K, (scene.T, 3, 3))
    evidence, _, sigma_px = resweep.camera_evidence(
        pairs, scene.cam_from_world, Ks, np.ones(scene.depth.shape, np.float32)
    )
    assert (pooling.pool(evidence, painted(scene.dynamic), pairs) == 0).all()
    assert sigma_px == resweep.SIGMA_RANGE_PX[0]


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    """Fixed bounds of depth, or a fixed ridge, would fail at one end."""
    reference = prior_with_cameras(make_scene(T=5, disc_radius=0.5))
    scaled = prior_with_cameras(make_scene(T=5, disc_radius=0.5, scale=scale))
    assert np.abs(scaled - reference).mean() < 1e-3


def test_an_empty_prior_gives_an_empty_mask() -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    smoothed = smooth_along_edges(np.zeros((30, 40)), rgb, 1000.0, 3.0)
    assert not to_mask(smoothed, guarded_threshold(smoothed, 0.5, 0.85), 5e-4).any()


def test_a_wholly_dynamic_frame_keeps_static_ground() -> None:
    """Masks that swallow the frame would leave bundle adjustment nothing; the surest part is kept."""
    probability = np.linspace(0.9, 1.0, 60 * 80, dtype=np.float32).reshape(60, 80)
    unguarded = to_mask(probability, 0.5, 5e-4)
    guarded = to_mask(probability, guarded_threshold(probability, 0.5, 0.85), 5e-4)
    assert unguarded.all()
    assert 0.5 < guarded.mean() <= 0.85


@pytest.mark.parametrize(("name", "least_iou"), [("alley_walk", 0.7), ("temple_orbit", 0.7), ("mountain_static", None)])
def test_masks_of_rendered_sequences(rendered: Path, name: str, least_iou: float | None) -> None:
    """With true cameras: IoU of at least 0.7, and next to nothing where nothing moves."""
    training, numbers = rendered / "training", range(3, 10)
    frames = [read_rgb(training / "final" / name / f"frame_{n:04d}.png") for n in numbers]
    cameras = [sintel.read_cam(training / "camdata_left" / name / f"frame_{n:04d}.cam") for n in numbers]
    grey = np.stack([frame.mean(axis=-1).round().astype(np.uint8) for frame in frames])
    flows = estimate_flow(grey, edge_list(len(grey), (1, 2, 3, 5)), 0, threads=2)
    order = sorted(flows)
    flow = np.stack([flows[edge] for edge in order])
    confidence = np.stack([flow_confidence(flows[i, j], flows[j, i], grey[i], grey[j]) for i, j in order])
    source, target = np.array(order).T
    pairs = flow_pairs(source, target, flow, confidence)
    poses = np.tile(np.eye(4), (len(grey), 1, 1))
    poses[:, :3] = [cam_from_world for _, cam_from_world in cameras]
    start = np.full(grey.shape, 0.2, np.float32)
    seen = poses, np.stack([K for K, _ in cameras])
    evidence, inverse_depth, _ = resweep.camera_evidence(pairs, *seen, start)
    rgb, projections = np.stack(frames), resweep.projections(pairs, *seen)
    evidence, _ = photometric.corroborate(evidence, rgb, pairs, projections, inverse_depth)
    residual = pooling.pool(evidence, rgb, pairs)
    probability, options = motion_stage.to_probability(residual, *motion_stage.CAMERA_CURVE), SegmentOptions()
    pixels = superpixels(len(frames), lambda k: frames[k])
    sure_of = confidence_of(pixels.means(evidence.weight))
    linked = Links(pixels, pairs.columns, options.permanence)
    sure, _ = persistent(linked, pixels.means(probability), sure_of, options.threshold)
    found = np.stack([to_mask(pixels.paint(sure, k), 0.5, options.min_area) for k in range(len(frames))])
    truth = np.stack([read_mask(training / "motion_mask" / name / f"frame_{n:04d}.png") for n in numbers])
    if least_iou is None:
        assert found.mean() < 0.001
    else:
        assert (found & truth).sum() / (found | truth).sum() >= least_iou


@pytest.mark.parametrize("lonely", [0, 2, 4])
def test_a_frame_without_edges_has_no_evidence(lonely: int) -> None:
    """Summed by segments, an empty one takes what belongs to the next frame, and the last one none there is."""
    scene = make_scene(T=5)
    pairs = observed(scene)
    kept = pairs.source != lonely
    pairs = flow_pairs(*(values[kept] for values in pairs.columns.values()))
    Ks, start = np.broadcast_to(scene.K, (scene.T, 3, 3)), np.ones(scene.depth.shape, np.float32)
    evidence, _, _ = resweep.camera_evidence(pairs, scene.cam_from_world, Ks, start)
    assert (evidence.weight[lonely] == 0).all()
    assert (evidence.weight[[k for k in range(5) if k != lonely]].max(axis=(1, 2)) > 1).all()
