"""Stage 1 of the control points: rest positions, the fitted motion, and points added to it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from track_tables import sightings

from stages.control import adapt, fitting, stage1
from stages.control.options import ControlOptions
from stages.control.rest import LONG_FRAMES, rest_positions
from stages.control.sightings import Sightings
from stages.deformation import lbs
from stages.deformation.motion_models import LONG_KNOTS, Deformation, TableDeformation
from stages.shared.cameras import centred_intrinsics, make_cameras, project, unproject
from stages.shared.split import SplitOptions, held_out


def turning_body(times: np.ndarray, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """A box of points [n, 3] that turns by 40 degrees and travels: positions [n, T, 3], and its shape at time 0.5."""
    rng = np.random.default_rng(1)
    shape = rng.uniform(-0.5, 0.5, (count, 3))
    turns = Rotation.from_rotvec(np.outer(times - 0.5, [0, np.radians(40), 0])).as_matrix()
    travel = np.outer(times - 0.5, [1.0, 0.2, 0.3]) + np.array([0, 0, 4.0])
    return np.einsum("tab,nb->nta", turns, shape) + travel, shape


def sightings_of(moved: np.ndarray, frames: np.ndarray, T: int, depth_error: np.ndarray | float = 1.0) -> Sightings:
    """What the body's exact tracks look like to a fixed camera; `depth_error` multiplies the depth [n, F]."""
    K = centred_intrinsics(200.0, 256, 192)
    uv, depth = project(moved, np.eye(4), K)
    depth = depth * depth_error
    lifted = unproject(uv, depth, np.eye(4), K)
    std = np.full(depth.shape, 0.02 if np.isscalar(depth_error) else 0.5)
    return sightings(frames, frames / (T - 1), np.ones(depth.shape, bool), uv, depth, std, lifted)


def tracks_of(moved: np.ndarray, visible: np.ndarray) -> Sightings:
    """Tracks [n, F, 3] in the world alone."""
    F = np.arange(visible.shape[1])
    return sightings(F, F / F[-1], visible, moved[..., :2], moved[..., 2], moved[..., 2], moved)


def training(T: int) -> np.ndarray:
    return ~held_out(T, SplitOptions())


def fit_body(
    depth_error: np.ndarray | float = 1.0, T: int = 17, **changes: object
) -> tuple[Deformation, dict, Sightings, np.ndarray]:
    frames = np.flatnonzero(training(T))
    all_moved, _ = turning_body(np.arange(T) / (T - 1))
    seen = sightings_of(all_moved[:, frames], frames, T, depth_error)
    cameras = make_cameras(np.tile(np.eye(4), (T, 1, 1)), centred_intrinsics(200.0, 256, 192), np.arange(1, T + 1))
    options = ControlOptions(**{"control_points": 60, "steps": 120, **changes})
    model, report = stage1.fit_sightings(seen, cameras, 0.05, options)
    assert model is not None
    return model, report, seen, all_moved


def carried(model: Deformation, rest: np.ndarray, time: float) -> np.ndarray:
    """Where `model` takes points [n, 3] of the canonical frame."""
    return skinned(model, torch.from_numpy(rest.astype(np.float32)), time).numpy()


def skinned(model: Deformation, means: torch.Tensor, time: float) -> torch.Tensor:
    index, sq_dist = lbs.neighbours(model.points, means, fitting.NEIGHBOURS)
    with torch.no_grad():
        quats, translations = model(torch.tensor([time]))
        weights = lbs.lbs_weights(sq_dist, model.log_radii, index)
        unit = torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
        return lbs.blend(means, unit, model.points, quats[0], translations[0], weights, index)[0]


def test_the_table_follows_a_turning_body_and_the_frames_left_out() -> None:
    model, report, seen, moved = fit_body()
    assert report["status"] == "fitted"
    assert report["median_px"] < 0.3
    assert report["at_rest_px"] > 5
    K = centred_intrinsics(200.0, 256, 192)
    rest = seen.moved[seen.frame == list(seen.frames).index(report["canonical_frame"] - 1)]
    for frame in (4, 12):
        uv, _ = project(carried(model, rest, frame / 16), np.eye(4), K)
        truth, _ = project(moved[:, frame], np.eye(4), K)
        assert np.median(np.linalg.norm(uv - truth, axis=1)) < 1.0


def test_a_long_clip_takes_more_frames_into_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that is seldom drawn moves far when it is: Adam divides by how often."""
    found = fit_body(T=241, steps=60, control_points=24, learning_rate=0.02)[1]
    monkeypatch.setattr(fitting, "SHARE_PER_STEP", 0)
    naive = fit_body(T=241, steps=60, control_points=24, learning_rate=0.02)[1]
    assert found["p90_px"] < 0.8 * naive["p90_px"]


def test_poor_depth_of_the_movers_does_not_spoil_their_image() -> None:
    _, shape = turning_body(np.zeros(1))
    jumps = np.random.default_rng(2).normal(0, 0.1, 15)  # the border that the depth is filled from changes by frame
    error = np.exp(0.5 * shape[:, :1] + 0.5 + jumps)
    _, report, _, _ = fit_body(error)
    assert report["median_px"] < 1.0


def test_the_network_learns_from_the_table() -> None:
    """From the tracks alone it is at a fifth of the motion, some 3 px, after as many steps."""
    _, report, _, _ = fit_body(model="mlp", width=64, steps=80)
    assert report["table_median_px"] < 0.3
    assert report["median_px"] < 0.5


@pytest.mark.parametrize("T", [17, 129])
def test_motion_that_cannot_be_explained_is_reported_after_another_attempt(T: int) -> None:
    """Every track goes its own way: no motion of control points carries them."""
    rng = np.random.default_rng(0)
    frames = np.flatnonzero(training(T))
    scattered = turning_body(frames / (T - 1))[0] + np.cumsum(rng.normal(0, 0.1, (400, len(frames), 3)), axis=1)
    cameras = make_cameras(np.tile(np.eye(4), (T, 1, 1)), centred_intrinsics(200.0, 256, 192), np.arange(1, T + 1))
    options = ControlOptions(steps=10, control_points=64)
    _, report = stage1.fit_sightings(sightings_of(scattered, frames, T), cameras, 0.05, options)
    assert report["status"] == "stuck"
    assert report["attempts"] == 2
    assert report["control_points"] == 64


def test_a_mover_that_only_passes_is_not_tried_from_a_frame_without_it() -> None:
    """A frame a quarter of the clip away sees none of its tracks, and no control point could start there."""
    T, frames = 20, np.arange(20)
    rng = np.random.default_rng(0)
    moved = turning_body(frames / (T - 1), 40)[0] + np.cumsum(rng.normal(0, 0.1, (40, T, 3)), axis=1)
    K, visible = centred_intrinsics(200.0, 256, 192), np.tile(frames < 4, (40, 1))
    uv, depth = project(moved, np.eye(4), K)
    seen = sightings(frames, frames / (T - 1), visible, uv, depth, np.full(depth.shape, 0.02), moved)
    cameras = make_cameras(np.tile(np.eye(4), (T, 1, 1)), K, np.arange(1, T + 1))
    model, report = stage1.fit_sightings(seen, cameras, 0.05, ControlOptions(steps=10, control_points=8))
    assert model is not None
    assert (report["status"], report["attempts"]) == ("stuck", 1)


def test_motion_at_the_frames_of_a_long_clip_is_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times in single precision lie beside the knots: each step would weigh all frames of the clip."""
    monkeypatch.delattr("stages.deformation.motion_models.at_times")  # what weighs them
    report = fit_body(T=2 * LONG_KNOTS, steps=2, control_points=8)[1]
    assert report["control_points"] == 8


def test_a_noisy_fit_is_more_rigid_and_never_beyond_the_scene() -> None:
    noise = np.random.default_rng(3)
    seen = sightings_of(turning_body(np.arange(16) / 15)[0], np.arange(16), 16)
    noisy = replace(seen, uv=seen.uv + noise.normal(0, 1.0, seen.uv.shape))
    cameras = make_cameras(np.tile(np.eye(4), (16, 1, 1)), centred_intrinsics(200.0, 256, 192), np.arange(1, 17))
    options = ControlOptions(steps=20, control_points=30)

    def weight(tracks: Sightings, most: float, choice: ControlOptions = options) -> float:
        return stage1.fit_sightings(tracks, cameras, most, choice)[1]["arap_weight"]

    assert weight(noisy, 0.5) > weight(seen, 0.5) >= stage1.MIN_ARAP
    assert weight(noisy, stage1.MIN_ARAP) == stage1.MIN_ARAP
    assert weight(noisy, 0.5, options.model_copy(update={"arap": 0.0})) == 0.0


def test_points_are_added_where_the_gradient_is_high_and_change_little() -> None:
    torch.manual_seed(0)
    points = torch.rand(20, 3)
    table = TableDeformation(points, torch.full((20,), -1.5), torch.linspace(0, 1, 5))
    with torch.no_grad():
        table.table += 0.05 * torch.randn(table.table.shape)
    carried = torch.rand(500, 3)
    gradients = torch.where((carried[:, :1] > 0.8), 1.0, 0.01) * torch.randn(500, 3)
    index, sq_dist = lbs.neighbours(points, carried, 4)
    weights = lbs.lbs_weights(sq_dist, table.log_radii.detach(), index)
    pull = adapt.weighted_gradient(weights, index, gradients, 20)
    by_hand = [
        sum(float(weights[j, k] * gradients[j].square().sum()) for j, k in (index == p).nonzero()) for p in range(20)
    ]
    np.testing.assert_allclose(pull, by_hand, rtol=1e-4)
    places = adapt.new_places(carried, weights, index, gradients, 20, 6)
    assert places.shape == (6, 3)
    assert float(places[:, 0].min()) > 0.7
    kept = torch.arange(20) != 3
    grown = adapt.regrow(table, kept, places, 4)
    assert len(grown.points) == 25
    times = torch.linspace(0, 1, 5)
    (_, before), (_, after) = table(times), grown(times)
    torch.testing.assert_close(after[:, :19], before[:, kept])
    torch.testing.assert_close(places + after[:, 19:], torch.stack([skinned(table, places, float(t)) for t in times]))
    assert adapt.used(torch.tensor([[0, 2], [2, 3]]), 5).tolist() == [True, False, True, True, False]


def test_the_same_seed_gives_the_same_motion() -> None:
    one, two = (fit_body(steps=20, added_share=0.25)[0] for _ in range(2))
    for name, tensor in one.state_dict().items():
        assert torch.equal(tensor, two.state_dict()[name]), name


def test_a_mover_that_enters_late_rests_at_its_own_moment() -> None:
    times = np.linspace(0, 1, 8)
    body, _ = turning_body(times)
    visitor = body + np.array([6.0, 0, 0])
    moved = np.concatenate([body, visitor])
    visible = np.ones(moved.shape[:2], bool)
    visible[400:, :6] = False
    rest, own = rest_positions(tracks_of(moved, visible), 3)
    assert own == 400
    np.testing.assert_allclose(rest[:400], body[:, 3], atol=1e-5)
    np.testing.assert_allclose(rest[400:], visitor[:, 6], atol=1e-5)


def test_a_part_hidden_in_the_canonical_frame_is_carried_there() -> None:
    times = np.linspace(0, 1, 8)
    moved, _ = turning_body(times)
    visible = np.ones(moved.shape[:2], bool)
    visible[:100, :6] = False
    rest, own = rest_positions(tracks_of(moved, visible), 3)
    assert own == 0
    error = np.linalg.norm(rest[:100] - moved[:100, 3], axis=1)
    travelled = np.linalg.norm(moved[:100, 6] - moved[:100, 3], axis=1)
    assert np.median(error) < 0.2 * np.median(travelled)


@pytest.mark.parametrize("frames", [LONG_FRAMES, LONG_FRAMES + 1])
def test_the_start_follows_a_mover_that_few_tracks_see(frames: int) -> None:
    body = np.random.default_rng(0).uniform(-0.5, 0.5, (5, 3)) + np.array([0, 0, 4.0])
    moved = body[:, None] + np.linspace(0, 1, frames)[:, None] * [1.0, 0, 0]
    table = stage1._new_table(body, tracks_of(moved, np.ones(moved.shape[:2], bool)), 5)
    np.testing.assert_allclose(carried(table, body, 1.0), moved[:, -1], atol=1e-3)


def test_a_mover_that_comes_back_after_long_rests_at_one_moment_of_each_visit() -> None:
    """Its tracks are short, and where control points lie no track sees all of a visit; the start follows it all."""
    T, visits, span, rng = 120, ((0, 40), (70, 120)), 14, np.random.default_rng(0)
    moved, visible = [], []
    for first, last in visits:
        body, _ = turning_body(np.linspace(0, 1, last - first), 500)
        moved.append(np.full((500, T, 3), np.nan))
        moved[-1][:, first:last] = 4 * (body - [0, 0, 4.0]) + [8.0 * (first > 0), 0, 9.0]
        starts = rng.integers(first, last - span + 1, (500, 1))
        visible.append((np.arange(T) >= starts) & (np.arange(T) < starts + span))
    positions, seen = np.concatenate(moved), np.concatenate(visible)
    tracks = tracks_of(np.where(seen[..., None], positions, 0.0), seen)
    rest, own = rest_positions(tracks, 20)
    assert own == 0
    np.testing.assert_array_less(np.median(np.linalg.norm(rest[:500] - positions[:500, 20], axis=1)), 0.3)
    errors = np.linalg.norm(rest[500:, None] - positions[500:, 70:], axis=-1)
    moment = int(np.median(errors, axis=0).argmin())
    assert np.median(errors[:, moment]) < 0.3
    table = stage1._new_table(rest, tracks, 120)
    for k in (3, 37, 72, 95, 117):
        inside = seen[:, k]
        off = np.linalg.norm(carried(table, rest[inside], k / (T - 1)) - positions[inside, k], axis=1)
        travelled = np.linalg.norm(rest[inside] - positions[inside, k], axis=1)
        assert np.median(off) < max(0.25 * np.median(travelled), 0.2), k
