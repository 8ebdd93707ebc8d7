"""Radial distortion as a shared unknown of the adjustment: its derivatives, its estimate, and its decision."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import assembled, make_scene, observe, trajectory_error

from stages.ba import arguments, dba, distortion, reduced
from stages.ba.dense_system import DenseSystem
from stages.ba.graph import FlowGraph
from stages.ba.normal_equations import depth_steps, normal_equations
from stages.ba.proposal import linear_system
from stages.ba.state import BEYOND_INFINITY, DEPTH_PRIOR, FocalPrior, Level, State, Unknowns
from stages.shared import lie
from stages.shared.lens import distort

SIGMA_PX = 2.0
DAMPING = 0.1


@pytest.fixture(params=[None, np.array([1.0, 1.05, 1.1])], ids=["one focal length", "zoom"])
def tiny(request: pytest.FixtureRequest) -> tuple[FlowGraph, State]:
    """A small distorted problem, and a state near its solution."""
    scene = make_scene(T=3, size=(24, 36), zoom=request.param, lens=np.array([-0.1, 0.05]))
    graph = observe(scene, stride=8, noise_px=0.3)
    inverse_depth = graph.resample(1 / scene.depth, 1)
    lens = np.array([-0.05, 0.03])
    return graph, dba.normalise(State(scene.cam_from_world, inverse_depth, scene.focal_px * 1.03, request.param, lens))


def moved(state: State, step: np.ndarray, zoom: bool) -> State:
    """The state after a step of (twists, log focals, lens, inverse depths)."""
    T = len(state.cam_from_world)
    n = 6 * T + (T if zoom else 1)
    poses = lie.exp_se3(step[: 6 * T].reshape(-1, 6)) @ state.cam_from_world
    focals_px = state.focals_px * np.exp(step[6 * T : n])
    assert state.lens is not None
    depths = state.inverse_depth + step[n + 2 :].reshape(state.inverse_depth.shape)
    return State(poses, depths, 1.0, focals_px, state.lens + step[n : n + 2])


def residuals(graph: FlowGraph, state: State) -> np.ndarray:
    """Residuals [E, P, 2] in px of the distorted image, from the projection written out."""
    assert state.lens is not None
    rays = arguments.undistorted(graph, state.lens, graph.pixels) - graph.centre
    found = []
    for e, (i, j) in enumerate(zip(graph.source, graph.target, strict=True)):
        points = np.column_stack([rays / state.focals_px[i], np.ones(len(rays))])
        relative = state.cam_from_world[j] @ lie.inverse(state.cam_from_world[i])
        seen = points @ relative[:3, :3].T + state.inverse_depth[i][:, None] * relative[:3, 3]
        q = state.focals_px[j] * seen[:, :2] / seen[:, 2:]
        found.append(graph.matches[e] - graph.centre - graph.corner_px * distort(q / graph.corner_px, state.lens))
    return np.stack(found)


@pytest.mark.parametrize("at_infinity", [False, True])
def test_normal_equations_behind_a_lens_are_those_of_finite_differences(
    tiny: tuple[FlowGraph, State], at_infinity: bool
) -> None:
    graph, state = tiny
    if at_infinity:
        third = np.arange(state.inverse_depth.size).reshape(state.inverse_depth.shape) % 3 == 0
        state = replace(state, inverse_depth=np.where(third, BEYOND_INFINITY, state.inverse_depth))
        noise = 0.3 * np.random.default_rng(3).standard_normal(graph.matches.shape)
        seen = (graph.matches - residuals(graph, state) + noise).astype(np.float32)
        graph = replace(graph, matches=seen, masked=True)
    zoom = state.zoom is not None
    n = 6 * graph.T + (graph.T if zoom else 1) + 2
    size = n + state.inverse_depth.size
    steps = 1e-6 * np.eye(size)
    J = np.stack([-(residuals(graph, moved(state, h, zoom)) - residuals(graph, moved(state, -h, zoom))) for h in steps])
    J, r = J.reshape(size, -1).T / 2e-6, residuals(graph, state)
    W = np.repeat((graph.weights / (1 + (r**2).sum(-1) / SIGMA_PX**2) ** 2).ravel(), 2)
    H, g = J.T @ (J * W[:, None]), J.T @ (W * r.ravel())
    depths = slice(n, None)
    H[depths, depths] += DEPTH_PRIOR * np.eye(size - n)
    H[depths, depths] *= 1 + DAMPING * np.eye(size - n)
    g[depths] += DEPTH_PRIOR * (1 - state.inverse_depth.ravel())
    held = at_infinity & (state.inverse_depth.ravel() == BEYOND_INFINITY) & (g[depths] < 0)
    assert held.any() == at_infinity
    H[depths, :n][held], g[depths][held] = 0, 0
    S = H[:n, :n] - H[:n, depths] @ np.linalg.solve(H[depths, depths], H[depths, :n])
    rhs = g[:n] - H[:n, depths] @ np.linalg.solve(H[depths, depths], g[depths])

    data, at, lens = (
        arguments.observations(graph, state.lens),
        arguments.geometry(graph, state),
        arguments.lens_px(graph, state),
    )
    found = normal_equations(data, at, SIGMA_PX, DAMPING, DEPTH_PRIOR, zoom, lens)
    hessians, schur, curvatures, gradients = found
    relative = reduced.relative_motions(graph, state.cam_from_world)
    S_ours, rhs_ours = assembled(graph, relative, hessians, schur)
    unit = np.sqrt(np.diagonal(H)[:n])
    assert_allclose(S_ours / np.outer(unit, unit), S / np.outer(unit, unit), atol=1e-6)
    assert_allclose(rhs_ours / unit, rhs / unit, atol=1e-6 * np.abs(rhs / unit).max())
    step = np.random.default_rng(2).standard_normal(n)
    local = reduced.edge_steps(graph, relative, step, lens=True)
    depth_step = depth_steps(data, at, SIGMA_PX, curvatures, gradients, local, lens)
    expected = np.linalg.solve(H[depths, depths], g[depths] - H[depths, :n] @ step).reshape(depth_step.shape)
    assert_allclose(depth_step, expected, atol=1e-6 * np.abs(expected).max())
    assert_allclose(dba.errors_px(graph, state), np.linalg.norm(r, axis=-1), rtol=1e-5, atol=1e-6)


def test_without_a_distortion_the_system_is_that_of_a_pinhole(
    tiny: tuple[FlowGraph, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduced, "scale_direction", lambda _, diagonal: np.zeros(len(diagonal)))
    graph, state = tiny
    zoom = state.zoom is not None
    n = 6 * graph.T + (graph.T if zoom else 1)
    none = replace(state, lens=np.zeros(2))
    unknowns = Unknowns(focal=True, zoom=zoom)
    bent, pinhole = (linear_system(graph, of, SIGMA_PX, unknowns) for of in (none, replace(state, lens=None)))
    assert isinstance(bent, DenseSystem)
    assert isinstance(pinhole, DenseSystem)
    (S, rhs), (expected, right) = (bent.S, bent.rhs), (pinhole.S, pinhole.rhs)
    assert_allclose(S[:n, :n], expected, atol=1e-9 * np.abs(expected).max())
    assert_allclose(rhs[:n], right, atol=1e-9 * np.abs(right).max())


def test_the_adjustment_finds_the_path_the_focal_length_and_both_coefficients() -> None:
    k = np.array([-0.2, 0.08])
    scene = make_scene(T=8, size=(96, 160), lens=k)
    graph = observe(scene)
    start = State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), 1.1 * scene.focal_px)
    levels, prior = (Level(2.0, 30), Level(0.5, 40)), FocalPrior(1.1 * scene.focal_px)
    bent, _ = dba.solve(graph, replace(start, lens=np.zeros(2)), levels, Unknowns(True, lens=2), prior, "test")
    assert bent.lens is not None
    assert_allclose(bent.lens * (scene.focal_px / graph.corner_px) ** np.array([2, 4]), k, rtol=0.03)
    assert bent.focal_px == pytest.approx(scene.focal_px, rel=0.005)
    assert trajectory_error(bent.cam_from_world, scene.cam_from_world) < 1e-3
    plain, _ = dba.solve(graph, start, levels, Unknowns(True), prior, "test")
    assert trajectory_error(plain.cam_from_world, scene.cam_from_world) > 0.005


@pytest.mark.parametrize(
    ("numbers", "decision"),
    [
        ((0.1, 0.02, -0.04, 0.005), "distorted"),
        ((0.01, 0.001, -0.04, 0.005), "straight"),
        ((0.1, 0.06, -0.04, 0.005), "straight"),
        ((0.1, 0.02, -0.01, 0.005), "straight"),
        ((0.1, 0.02, -0.04, 0.015), "not observable"),
        ((0.1, 0.02, -0.2, 0.03), "not observable"),
    ],
    ids=["clear", "too little gain", "gain by chance", "within its error", "uncertain", "blind"],
)
def test_the_decision_follows_gain_and_shift_and_their_errors(numbers: tuple[float, ...], decision: str) -> None:
    assert distortion.judge(*numbers)[0] == decision
