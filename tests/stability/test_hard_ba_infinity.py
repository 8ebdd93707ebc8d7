"""Hard cases of depths at infinity: a step beyond it, and noise around it."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import Scene, make_scene, observe, trajectory_error

from stages.ba import dba, initialise
from stages.ba.depth import depth_maps
from stages.ba.graph import FlowGraph
from stages.ba.proposal import propose
from stages.ba.state import BEYOND_INFINITY, FocalPrior, Level, Unknowns
from stages.shared import lie


def before_infinity(turn: float, seed: int) -> tuple[Scene, FlowGraph]:
    """A camera that goes ahead and turns by `turn` radians; a quarter of its view and more is at infinity."""
    path = lie.exp_se3(np.outer(np.linspace(0, 1.5, 8), [0.1, 0, -1, 0, turn, 0]))
    floor, side, sky = ((0.0, 1.0, 0.0), 1.0), ((1.0, 0.0, 0.0), 2.0), ((0.0, 0.0, 1.0), 1e4)
    room = make_scene(T=8, size=(96, 160), path=path, planes=(floor, side, sky))
    assert 0.2 < (room.depth > 5e3).mean() < 0.4
    return room, replace(observe(room, noise_px=0.1, seed=seed), masked=True)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_step_lowers_the_cost_where_depths_are_at_infinity(seed: int) -> None:
    """The lens is too short, which draws depths beyond infinity: a step for which they are free there goes too far."""
    room, graph = before_infinity(0.0, seed)
    state = dba.normalise(initialise.initial_state(graph, room.cam_from_world, 0.8 * room.focal_px, 1.0))
    at_infinity = state.inverse_depth < 2e-4
    state = replace(state, inverse_depth=np.where(at_infinity, BEYOND_INFINITY, state.inverse_depth))
    before = dba.robust_cost(graph, dba.errors_px(graph, state), 1.0)

    def after(graph: FlowGraph) -> float:
        stepped, _ = propose(graph, state, 1.0, 1e-6, Unknowns(focal=True, zoom=True), FocalPrior(1.1 * 160))
        assert stepped is not None
        return dba.robust_cost(graph, dba.errors_px(graph, stepped), 1.0)

    assert after(graph) < 0.5 * before
    assert after(replace(graph, masked=False)) > before


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_at_infinity_hardly_draws_the_cameras(seed: int) -> None:
    """Held at infinity itself, where noise goes one way, depths shorten the focal length by .9 to 1 %."""
    room, graph = before_infinity(0.2, seed)
    state = initialise.initial_state(graph, room.cam_from_world, 0.94 * room.focal_px, 1.0)
    levels = (Level(1.0, 12, 1e-3), Level(0.5, 15, 1e-4))
    found, _ = dba.solve(graph, state, levels, Unknowns(focal=True), FocalPrior(1.1 * 160), "test")
    assert trajectory_error(found.cam_from_world, room.cam_from_world) < 4e-4
    assert found.focal_px == pytest.approx(room.focal_px, rel=8e-3)
    depths = depth_maps(graph, graph, found, np.ones((8, 96, 160), np.int8), True)
    assert (depths.inverse_depth > 0).all()
