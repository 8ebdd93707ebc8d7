"""Ground before the camera: it rests where the camera only turns, whatever passes, and moves where that translates."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import Scene, make_scene, observe

from stages.ba import classify, diagnostics, ground
from stages.ba import estimate as hypotheses
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.state import FocalPrior
from stages.ba.weights import mask_graph
from stages.shared import lie

SIZE = (96, 160)
PRIOR = FocalPrior(1.1 * SIZE[1])


def observed(motion: str, disc_radius: float) -> FlowGraph:
    return observe(make_scene(size=SIZE, motion=motion, disc_radius=disc_radius), noise_px=0.05, masked=False)


@pytest.mark.parametrize("disc_radius", [0.0, 0.5, 0.75])
def test_ground_rests_before_a_camera_that_turns_whatever_passes(disc_radius: float) -> None:
    share = ground.at_rest(observed("rotate", disc_radius), PRIOR, None)
    assert share is not None
    assert share > classify.AT_REST


@pytest.mark.parametrize("disc_radius", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("motion", ["curve", "drift"])
def test_ground_moves_before_a_camera_that_translates(motion: str, disc_radius: float) -> None:
    share = ground.at_rest(observed(motion, disc_radius), PRIOR, None)
    assert share is not None
    assert share < classify.MOVES


def walk(T: int, frames: slice) -> Scene:
    """A camera that turns, and walks sideways in some frames."""
    step, turn, none = np.zeros(T), np.cumsum(np.where(np.arange(T) % 20 < 10, 0.03, -0.03)), np.zeros((5, T))
    step[frames] = 0.08
    walked = lie.exp_se3(np.stack([-np.cumsum(step), *none], axis=1))
    return make_scene(T=T, size=SIZE, path=lie.exp_se3(np.stack([*none[:4], turn, none[0]], axis=1)) @ walked)


def test_ground_moves_where_a_camera_turns_first_and_then_walks() -> None:
    share = ground.at_rest(observe(walk(16, slice(9, 16)), noise_px=0.05), PRIOR, None)
    assert share is not None
    assert share < classify.MOVES


def test_ground_that_is_not_matched_while_a_camera_walks_says_nothing() -> None:
    graph = observe(walk(18, slice(12, 18)), noise_px=0.05)
    share = ground.at_rest(graph, PRIOR, None)
    assert share is not None
    assert share < classify.MOVES
    unseen = (graph.source >= 11)[:, None] & (graph.pixels[:, 1] > 0.6 * SIZE[0])
    assert ground.at_rest(replace(graph, weights=np.where(unseen, 0.0, graph.weights)), PRIOR, None) is None


def test_a_walk_in_a_long_clip_is_seen() -> None:
    """In an eighth of its frames, neither at its beginning nor in its middle or at its end."""
    share = ground.at_rest(observe(walk(200, slice(44, 69)), noise_px=0.05), PRIOR, None)
    assert share is not None
    assert share < classify.MOVES


def test_what_the_camera_carries_along_is_no_ground_at_rest() -> None:
    """The bonnet of a car fills the lower quarter of the image: a turning camera that hardly turns fits it."""
    graph = observed("curve", 0.0)
    bonnet = graph.pixels[:, 1] > 0.75 * SIZE[0]
    carried = replace(graph, matches=np.where(bonnet[:, None], graph.pixels, graph.matches).astype(np.float32))
    share = ground.at_rest(carried, PRIOR, None)
    assert share is None or share < classify.MOVES
    assert estimate(Problem(carried, masked=False), BAOptions()).camera == "moving"


def test_ground_without_sure_matches_says_nothing() -> None:
    graph = observed("rotate", 0.0)
    low = graph.pixels[:, 1] > 0.6 * SIZE[0]
    assert ground.at_rest(replace(graph, weights=np.where(low, 0.0, graph.weights)), PRIOR, None) is None


def test_movers_that_travel_together_past_a_tripod_are_no_path() -> None:
    """All that rests would be at infinity before that path, the ground too, and nothing would be left to move."""
    scene = make_scene(size=SIZE, motion="rotate", disc_radius=0.5)
    plain_above = scene.dynamic | (np.arange(SIZE[0])[:, None] > 0.7 * SIZE[0])
    graph = mask_graph(observe(scene, noise_px=0.05, masked=False), plain_above)
    assert classify.measure(graph, None, 0).camera == "moving"
    solution = estimate(Problem(graph, masked=False), BAOptions())
    assert solution.camera == "rotating"
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.02)
    assert any("lower border rests" in flag for flag in solution.flags)


def test_ground_at_rest_still_counts_where_rotations_fail_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look over more frames then seems to show that the camera moves, as slow movers would."""
    graph, solve = observed("rotate", 0.0), hypotheses.estimate_rotations
    turns = classify.measure(graph, None, 0)
    looks = iter([turns])
    monkeypatch.setattr(classify, "measure", lambda *_: next(looks, replace(turns, rotation_px=10.0)))
    monkeypatch.setattr(hypotheses, "estimate_rotations", lambda *a: replace(solve(*a), failed_checks=["grows"]))
    assert estimate(Problem(graph, masked=False), BAOptions()).camera == "rotating"


def test_a_camera_that_seems_to_turn_is_doubted_where_the_ground_moves() -> None:
    measured = classify.measure(observed("rotate", 0.0), None, 0)
    assert not measured.doubtful
    assert replace(measured, ground=classify.MOVES / 2).doubtful
    assert not replace(measured, ground=classify.MOVES).doubtful


@pytest.mark.parametrize(("height", "told"), [(1.0, False), (0.7, True), (0.0, True)])
def test_masks_over_all_that_is_near_are_told_of(height: float, told: bool) -> None:
    """Masks below a share of the height, over a ground that truly rests."""
    scene = make_scene(size=SIZE)
    plain = observe(scene, noise_px=0.05)
    masks = np.broadcast_to(np.arange(SIZE[0])[:, None] >= height * SIZE[0], scene.dynamic.shape)
    masked = mask_graph(plain, ~masks)
    kept = ground.share_kept(masked, plain)
    assert bool(diagnostics.of_near(kept, known_focal=False)) == told
    assert not any("intrinsics" in warning for warning in diagnostics.of_near(kept, known_focal=True))
    assert ground.share_kept(plain, plain) is None


def test_masks_of_what_passes_leave_weakly_textured_ground() -> None:
    """A match counts by its weight: pixels that are hardly matched are not lost where one match in three is masked."""
    plain = observe(make_scene(size=SIZE), noise_px=0.05)
    plain = replace(plain, weights=np.full_like(plain.weights, 0.4))
    masked = replace(plain, weights=plain.weights * (np.arange(len(plain.source)) % 3 > 0)[:, None])
    assert ground.share_kept(masked, plain) == pytest.approx(2 / 3, abs=0.05)
