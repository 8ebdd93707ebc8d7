"""A large rigid mover that masks miss in part bends the cameras; adjustment to what fits at the noise frees them."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import Scene, make_scene, observe, trajectory_error

from stages.ba import initialise, trim
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.initialise import Candidate
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.state import FocalPrior, Level, Unknowns
from stages.ba.weights import mask_graph

SIGMA_PX = 0.08
FREE = Unknowns(focal=True)


def half_masked() -> tuple[Scene, FlowGraph]:
    """Noisy matches of a static scene whose right half slides along the rows; the upper half of that is masked."""
    scene = make_scene(T=8, size=(96, 160))
    graph = observe(scene, stride=4)
    u, v = (graph.pixels / (graph.width, graph.height)).T
    moving = u > 0.5
    slide = (graph.target - graph.source)[:, None] * moving * (3 + 2 * v)
    matches = graph.matches + 0.03 * np.random.default_rng(0).standard_normal(graph.matches.shape).astype(np.float32)
    matches[..., 0] += slide
    return scene, replace(graph, matches=matches, weights=graph.weights * ~(moving & (v < 0.5)))


def biased(scene: Scene, graph: FlowGraph) -> Candidate:
    """What adjustment makes of it, down to the scale of the noise."""
    state = initialise.initial_state(graph, scene.cam_from_world, 1.25 * scene.focal_px)
    for levels in ((Level(1.0, 12), Level(0.5, 15)), (Level(SIGMA_PX, 15),)):
        state = initialise.search_depth(graph, state, levels[0].sigma_px)
        found = initialise.adjust(graph, state, levels, FREE, FocalPrior(scene.focal_px), "test")
        state = found.state
    return found


def test_trimming_frees_the_cameras_from_a_mover_that_is_partly_masked() -> None:
    scene, graph = half_masked()
    start = biased(scene, graph)
    found = trim.concentrate(graph, 0.25, start, SIGMA_PX, FREE, FocalPrior(scene.focal_px))
    before, after = (trajectory_error(c.state.cam_from_world, scene.cam_from_world) for c in (start, found))
    assert before > 0.005
    assert after < 0.001
    assert abs(start.state.focal_px / scene.focal_px - 1) > 0.05
    assert abs(found.state.focal_px / scene.focal_px - 1) < 0.01


@pytest.mark.parametrize("masked", [0.1, 0.4])
def test_large_masks_alone_set_off_trimming(masked: float) -> None:
    graph = observe(make_scene(T=6), stride=4, noise_px=0.05)
    static = np.ones((6, 64, 96), np.float32)
    static[:, :, : round(96 * masked)] = 0
    problem = Problem(mask_graph(graph, static), masked=True, unmasked=graph)
    phases = {step.phase for step in estimate(problem, BAOptions(start_focals=(1.0,))).steps}
    assert ("refinement, trimmed" in phases) == (masked > trim.LARGE)


def test_trimming_keeps_what_it_cannot_better() -> None:
    """Noise alone: leaving out what fits worst would run away, at a lower cost of what is left."""
    scene = make_scene(T=6, size=(64, 96))
    graph = observe(scene, stride=4)
    noise = 0.1 * np.random.default_rng(0).standard_normal(graph.matches.shape)
    graph = replace(graph, matches=(graph.matches + noise).astype(np.float32))
    state = initialise.initial_state(graph, scene.cam_from_world, scene.focal_px)
    start = Candidate("test", state, 0.0, 0.0, [])
    found = trim.concentrate(graph, 0.5, start, SIGMA_PX, FREE, FocalPrior(scene.focal_px))
    assert found.state is start.state
    assert trim.concentrate(graph, 0.1, start, SIGMA_PX, FREE, FocalPrior(scene.focal_px)) is start
