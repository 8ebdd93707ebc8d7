"""The priors on depths and focal length, whose weight falls where flow is quiet."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import make_scene, observe
from test_ba_start import true_state

from stages.ba import dba
from stages.ba import state as ba_state
from stages.ba.graph import FlowGraph
from stages.ba.proposal import propose
from stages.ba.state import QUIET_PX, FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import focal_sigma


def test_where_flow_is_quiet_the_priors_move_the_focal_length_by_less_than_its_predicted_error() -> None:
    """Priors of unchanged weight, at the narrow kernel of so little noise, move it by twice that error."""
    scene = make_scene()
    graph = observe(scene, noise_px=0.01)
    start, found = dba.normalise(true_state(scene, graph)), []
    for ratio in (0.6, 1.6):
        prior = FocalPrior(ratio * scene.focal_px)
        found.append(dba.solve(graph, start, (Level(0.05, 30),), Unknowns(focal=True), prior, "test")[0])
    assert np.log(found[1].focal_px / found[0].focal_px) < 0.5 * focal_sigma(graph, found[0])


def test_priors_beside_quiet_flow_are_those_beside_as_many_more_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """At half of QUIET_PX, a quarter of the priors: alike in the cost and in the step that lowers it."""
    scene = make_scene(T=5)
    graph, sigma_px = observe(scene, noise_px=0.01), QUIET_PX / 2
    faint = replace(graph, weights=1e-3 * graph.weights)  # so that priors tell in the depth of every pixel
    state, unknowns = dba.normalise(true_state(scene, graph)), Unknowns(focal=True)
    prior = FocalPrior(0.5 * scene.focal_px)

    def proposed(graph: FlowGraph) -> tuple[float, State]:
        moved, _ = propose(graph, state, sigma_px, 1e-3, unknowns, prior)
        assert moved is not None
        return dba._objective(graph, state, sigma_px, unknowns, prior), moved

    cost, moved = proposed(faint)
    monkeypatch.setattr(ba_state, "QUIET_PX", sigma_px)
    alike_cost, alike = proposed(replace(graph, weights=4 * faint.weights))
    assert cost == pytest.approx(alike_cost, rel=1e-5)
    assert moved.focal_px == pytest.approx(alike.focal_px, rel=1e-5)
    assert_allclose(moved.inverse_depth, alike.inverse_depth, rtol=1e-4)
