"""Texture as a weight of the last adjustment: what it measures, and what it spares the focal length."""

import numpy as np
from synthetic import make_scene, observe

from stages.ba.initialise import adjust
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.texture import FLOOR, texture_weights
from stages.ba.weights import favour_distance, with_texture


def test_flat_walls_and_straight_edges_have_no_texture() -> None:
    grey = np.full((60, 90), 100, np.uint8)
    grey[:, 45:] = 180
    grey[:, 70:] += np.random.default_rng(0).integers(0, 75, (60, 20)).astype(np.uint8)
    weights = texture_weights(grey)
    assert (weights[:, :60] < 0.1).all()
    assert weights[:, 78:].min() > 0.6
    assert weights.min() >= FLOOR


def test_flow_smoothed_where_texture_is_missing_spares_the_focal_length() -> None:
    """A third of the picture loses a tenth of its expansion, alike in all edges, as smooth flow on a flat wall does."""
    scene = make_scene(size=(96, 160))
    graph = observe(scene, noise_px=0.02)
    flat = graph.pixels[:, 0] > 105
    flow = graph.matches[:, flat] - graph.pixels[flat].astype(np.float32)
    graph.matches[:, flat] -= 0.1 * (flow - flow.mean(axis=1, keepdims=True))
    texture = np.ones((scene.T, 96, 160), np.float32)
    texture[:, :, 105:] = FLOOR
    start = State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px)
    errors = []
    for observed in (graph, with_texture(graph, texture)):
        observed = favour_distance(observed)
        prior = FocalPrior(1.1 * graph.width)
        found = adjust(observed, start, (Level(0.5, 15),), Unknowns(focal=True), prior, "sharp")
        errors.append(abs(found.state.focal_px / scene.focal_px - 1))
    assert errors[1] < 0.5 * errors[0]
