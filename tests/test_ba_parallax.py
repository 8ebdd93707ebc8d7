"""Paths solved beside cameras that seem to turn: which of the two is taken."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import make_scene, observe
from test_ba_start import true_state

from stages.ba.estimate import NOISE_LEAVES, PARALLAX, better
from stages.ba.problem import Estimate
from stages.ba.refinement import CONSISTENT_SHARE
from stages.ba.state import State

ROUGH = ["rough camera path"]


def estimate_of(state: State, residual_px: float, failed_checks: list[str]) -> Estimate:
    return Estimate(state, "moving", np.zeros((1, 6, 6)), residual_px, {}, {}, failed_checks)


@pytest.mark.parametrize("failed", [[], ROUGH])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_a_path_that_fails_a_check_must_explain_nearly_all_matches(failed: list[str], share: float) -> None:
    """Where it leaves a fifth of the residual of the turns: a share of the matches is 5 px from where it has them."""
    scene = make_scene(T=5)
    graph = observe(scene)
    state, rng = true_state(scene, graph), np.random.default_rng(0)
    graph.matches[rng.random(graph.matches.shape[:2]) < share] += 5.0
    turns = replace(state, cam_from_world=np.stack([np.eye(4)] * 5))
    path = estimate_of(state, 0.2, failed)
    assert (better(path, estimate_of(turns, 1.0, []), graph) is path) == (not failed or 1 - share > CONSISTENT_SHARE)


@pytest.mark.parametrize(("left", "taken"), [(PARALLAX - 0.02, True), (PARALLAX + 0.02, False)])
def test_a_path_counts_by_the_residual_that_it_leaves_of_the_turns(left: float, taken: bool) -> None:
    scene = make_scene(T=5)
    graph = observe(scene)
    state = true_state(scene, graph)
    turns = replace(state, cam_from_world=np.stack([np.eye(4)] * 5))
    path = estimate_of(state, left, [])
    assert (better(path, estimate_of(turns, 1.0, []), graph) is path) == taken


@pytest.mark.parametrize(
    ("failed", "left", "told"),
    [
        (ROUGH, 0.3, True),
        *[(failed, NOISE_LEAVES - 0.02, True) for failed in ([], ROUGH)],
        *[(failed, NOISE_LEAVES + 0.02, False) for failed in ([], ROUGH)],
    ],
)
def test_turns_are_doubted_where_a_path_that_is_not_taken_explains_more_than_noise(
    failed: list[str], left: float, told: bool
) -> None:
    """A third of the matches is 5 px from where a path has them, so that it is not taken if it fails a check."""
    scene = make_scene(T=5)
    graph = observe(scene)
    state, rng = true_state(scene, graph), np.random.default_rng(0)
    graph.matches[rng.random(graph.matches.shape[:2]) < 1 / 3] += 5.0
    turns = estimate_of(replace(state, cam_from_world=np.stack([np.eye(4)] * 5)), 1.0, [])
    doubted = better(estimate_of(state, left, failed), turns, graph)
    assert doubted.failed_checks == []
    assert any("may translate" in flag for flag in doubted.flags) == told
    assert any(ROUGH[0] in flag for flag in doubted.flags) == (told and failed == ROUGH)


def test_a_path_that_explains_no_more_of_resting_ground_than_turns_is_not_taken() -> None:
    """Movers that travel together before a camera that turns: the path explains them, and the ground no better."""
    scene = make_scene(size=(96, 160), motion="rotate")
    graph = observe(scene, noise_px=0.05)
    turns = true_state(scene, graph)
    path = estimate_of(turns, 0.01, [])  # of 0.03 px
    assert better(path, estimate_of(turns, 1.0, []), graph) is not path
    unmatched = replace(graph, weights=graph.weights * (graph.pixels[:, 1] < 60))
    assert better(path, estimate_of(turns, 1.0, []), unmatched) is path
