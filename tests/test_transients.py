"""What a single frame shows: a small thing that moves farther from frame to frame than its own size."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from passed_wall import EDGES, T, texture

from stages.motion import __main__ as motion_stage
from stages.motion.epipolar import Evidence
from stages.motion.options import MotionOptions
from stages.motion.photometric import corroborate
from stages.motion.transients import LEAST_FRAMES, Others
from stages.shared.artifacts import Dense, read_dense, write_dense, write_json
from stages.shared.cameras import make_cameras, write_cameras
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json

SIZE, STEP, FAST = (80, 150), 2, (12, -3)
"""Of a wall that a camera passes sideways by STEP px a frame, before which a ball moves by FAST."""
INNER = slice(1, T - 1)


def ball(k: int, step_px: tuple[int, int]) -> np.ndarray:
    """Where [h, w] a ball of 9 px is in frame k, which moves so far right and down."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.asarray((y - 40 - step_px[1] * (k - 4)) ** 2 + (x - 75 - step_px[0] * (k - 4)) ** 2 <= 20)


def clip(step_px: tuple[int, int] | None, noise: float = 0.0, brighter: float = 0.0) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 of the wall, with a red ball before it if it has a step; frame 4 is `brighter`."""
    wall, rng = texture(0, (SIZE[0], SIZE[1] + T * STEP)), np.random.default_rng(3)
    frames = []
    for k in range(T):
        frame = wall[:, STEP * k : STEP * k + SIZE[1]].astype(float)
        if step_px is not None:
            frame[ball(k, step_px)] = (220, 40, 30)
        frames.append(frame + noise * rng.standard_normal(frame.shape) + (brighter if k == 4 else 0))
    return np.clip(frames, 0, 255).astype(np.uint8)


def edges_of_wall() -> dict[str, np.ndarray]:
    """The columns of pairs.arrow whose flow is that of the wall, and sure but for where the ball is."""
    source, target = EDGES.T
    flow = np.zeros((len(EDGES), *SIZE, 2), np.float32)
    flow[..., 0] = -STEP * (target - source)[:, None, None]
    sure = np.where([cv2.dilate(ball(k, FAST).astype(np.uint8), np.ones((9, 9))) > 0 for k in source], 0.0, 1.0)
    return {"source": source, "target": target, "flow": flow, "confidence": sure.astype(np.float32)}


def passing(rgb: np.ndarray, flow: np.ndarray | None = None, depth: float = 1.0, confidence: float = 0.0) -> np.ndarray:
    """What single frames show [T, h, w], where the flow is that of the wall, or `flow` [E, h, w, 2], and nowhere sure,
    so that nothing but the pictures speaks against it."""
    columns = edges_of_wall()
    columns |= {"confidence": np.full_like(columns["confidence"], confidence)}
    pairs = FlowPairs(Dense(columns if flow is None else columns | {"flow": flow}))
    gaps = EDGES[:, 1] - EDGES[:, 0]
    lines = np.tile(np.eye(3), (len(EDGES), 1, 1)), gaps[:, None] * [-float(STEP), 0, 0]
    still = np.zeros((T, *SIZE), np.float32)
    _, found = corroborate(Evidence(still, np.ones_like(still)), rgb, pairs, lines, np.full_like(still, depth))
    return found


@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_a_ball_that_no_flow_follows_is_found_in_every_frame(noise: float) -> None:
    found = passing(clip(FAST, noise)) > 0.5
    for k in range(T)[INNER]:
        assert found[k][ball(k, FAST)].mean() > 0.6, k
        around = cv2.dilate(ball(k, FAST).astype(np.uint8), np.ones((9, 9))) > 0
        assert not found[k][~around].any(), k


def test_the_prior_shows_the_ball_of_every_frame(tmp_path: Path) -> None:
    """Where flow is lost, no other frame confirms it: pooled along the flow its evidence would be too weak."""
    frames = tmp_path / "clip"
    for k, rgb in enumerate(clip(FAST), start=1):
        write_image(frames / f"frame_{k:04d}.png", rgb)
    write_json(sequence := tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", frames)))
    columns = {name: of.astype(np.float16) if of.ndim > 1 else of for name, of in edges_of_wall().items()}
    write_dense(flow := tmp_path / "pairs.arrow", columns, {"width": SIZE[1], "height": SIZE[0], "scale": 1.0})
    K, poses = np.array([[100.0, 0, 74.5], [0, 100.0, 39.5], [0, 0, 1]]), np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = -STEP / 100 * np.arange(T)
    write_cameras(before := tmp_path / "poses.parquet", make_cameras(poses, K, np.arange(1, T + 1)))
    depth = {"frame": np.arange(1, T + 1), "inverse_depth": np.ones((T, 10, 18), np.float32)}
    write_dense(depths := tmp_path / "depth.arrow", depth, {"stride_px": 8})
    written = tmp_path / "prior.arrow", tmp_path / "motion.png"
    motion_stage.main(sequence, flow, *written, MotionOptions(), before, depths)
    probability = read_dense(written[0])["probability"]
    assert all((probability[k] > 0.5)[ball(k, FAST)].mean() > 0.6 for k in range(T)[INNER])
    status = np.where(np.arange(T) == 4, "unobserved", "estimated").astype(object)
    poses[4, 1, 3] = 0.3  # not its pose: all of the frame would be odd, of a wall that moves up by 30 px
    write_cameras(before, make_cameras(poses, K, np.arange(1, T + 1), status=status))
    motion_stage.main(sequence, flow, *written, MotionOptions(), before, depths)
    assert not (read_dense(written[0])["probability"][4] > 0.5).any()


@pytest.mark.parametrize(("noise", "brighter"), [(0.0, 0.0), (6.0, 0.0), (15.0, 0.0), (2.0, 25.0)])
def test_a_wall_alone_shows_nothing_through_noise_and_light(noise: float, brighter: float) -> None:
    assert (passing(clip(None, noise, brighter)) > 0.5).mean() < 1e-4


def test_what_rests_or_what_the_flow_follows_is_not_told_by_single_frames() -> None:
    assert not (passing(clip((-STEP, 0))) > 0.5).any()  # painted on the wall
    rgb, flow = clip(FAST), edges_of_wall()["flow"]
    for e, (i, j) in enumerate(EDGES):
        flow[e, cv2.dilate(ball(i, FAST).astype(np.uint8), np.ones((7, 7))) > 0] = np.array(FAST) * (j - i)
    inner = np.stack([cv2.erode(ball(k, FAST).astype(np.uint8), np.ones((3, 3))) > 0 for k in range(T)])
    assert (passing(rgb, flow)[inner] > 0.5).mean() < 0.15  # at rims the pictures mix both ways
    assert (passing(rgb)[INNER][inner[INNER]] > 0.5).mean() > 0.9


def test_what_the_flow_is_sure_of_is_not_told_by_single_frames() -> None:
    assert passing(clip(FAST), confidence=1.0).max() == 0


def test_a_surface_at_a_wrong_depth_that_the_flow_follows_shows_nothing() -> None:
    assert (passing(clip(None), depth=3.0) > 0.5).mean() < 1e-4


def test_light_that_changes_by_a_factor_shows_nothing() -> None:
    """By an offset alone a picture of smooth bright and dark parts would be odd in its darkest and brightest."""
    rgb = clip(None).astype(float)
    rgb[:, 10:30, 20:60], rgb[:, 40:70, 70:140] = 30, 200
    rgb[4] *= 1.2
    assert (passing(np.clip(rgb, 0, 255).astype(np.uint8)) > 0.37).mean() < 1e-3


@pytest.mark.parametrize("brighter", [2, 5])
def test_a_saturated_sky_shows_nothing_when_the_rest_gets_brighter(brighter: int) -> None:
    rgb = clip(None)
    rgb[:, :10] = 255
    rgb[4, 10:] += np.uint8(brighter)
    assert (passing(rgb) > 0.37).mean() < 1e-3


@pytest.mark.parametrize(("width", "most"), [(7, 0.2), (21, 0.0)])
def test_a_blurred_frame_is_no_thing_that_passes(width: int, most: float) -> None:
    """Where a mild blur leaves less than MOST of it odd, sure flow alone says that it is at rest."""
    rgb = clip(None)
    rgb[4] = cv2.blur(rgb[4], (width, 1))
    assert (passing(rgb)[4] > 0.37).mean() <= most
    assert not (passing(rgb, confidence=0.5) > 0.37).any()


def test_what_is_covered_in_all_later_frames_is_not_odd_in_the_first() -> None:
    rgb = clip(None)
    for k in range(T):
        rgb[k, 20:60, 30 + 6 * k : 80 + 6 * k] = 120
    ahead = passing(rgb)[0, 22:58, 82:95]
    assert not (ahead > 0.37).any()


def test_from_too_few_frames_nothing_is_told() -> None:
    seen = texture(0, SIZE)
    other = seen.copy()
    other[20:30, 20:40] //= 2
    others = Others(1, seen)
    for n in range(LEAST_FRAMES):
        told = others.odd(np.full(SIZE, 50.0, np.float32), np.ones(SIZE, np.float32))
        assert np.isfinite(told).all()
        assert not told.any(), n
        others.add(n > 0, 0, other, seen, np.ones(SIZE, bool))
    assert others.odd(np.full(SIZE, 50.0, np.float32), np.ones(SIZE, np.float32)).max() > 0.9
