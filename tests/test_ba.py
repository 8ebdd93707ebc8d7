"""Bundle adjustment: the solver against a dense reference, finite differences, exact scenes and gauge freedom."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, assembled, make_scene, observe, rotation_error_deg, trajectory_error

from stages.ba import arguments, dba, reduced
from stages.ba.dense_system import DenseSystem
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.normal_equations import depth_steps, normal_equations
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.proposal import linear_system
from stages.ba.state import BEYOND_INFINITY, DEPTH_PRIOR, FocalPrior, Level, State, Unknowns
from stages.shared import lie

OPTIONS = BAOptions()


def true_state(scene: Scene, graph: FlowGraph) -> State:
    """The exact solution on a graph."""
    return State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px)


def disturbed(state: State, size: float = 0.01, seed: int = 0) -> State:
    """A state off the truth: poses (all but the first), depths and focal length."""
    rng = np.random.default_rng(seed)
    twists = size * rng.standard_normal((len(state.cam_from_world), 6))
    twists[0] = 0
    inverse_depth = state.inverse_depth * np.exp(size * rng.standard_normal(state.inverse_depth.shape))
    return State(lie.exp_se3(twists) @ state.cam_from_world, inverse_depth, state.focal_px * (1 + size))


def residuals(graph: FlowGraph, state: State) -> np.ndarray:
    """Reprojection residuals [E, P, 2] in px, written out plainly."""
    result = []
    for e, (i, j) in enumerate(zip(graph.source, graph.target, strict=True)):
        rays = (graph.pixels - graph.centre) / state.focals_px[i]
        rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        relative = state.cam_from_world[j] @ np.linalg.inv(state.cam_from_world[i])
        points = rays @ relative[:3, :3].T + state.inverse_depth[i][:, None] * relative[:3, 3]
        projected = state.focals_px[j] * points[:, :2] / points[:, 2:] + graph.centre
        result.append(graph.matches[e] - projected)
    return np.stack(result)


def numeric_jacobian(graph: FlowGraph, state: State, step: float = 1e-6) -> np.ndarray:
    """Derivative [2 E P, 6 T + F + T P] of the projections by central differences, with F focal lengths."""
    T, P = state.inverse_depth.shape
    F = 1 if state.zoom is None else T

    def shifted(index: int, amount: float) -> np.ndarray:
        change = np.zeros(6 * T + F + T * P)
        change[index] = amount
        poses = lie.exp_se3(change[: 6 * T].reshape(T, 6)) @ state.cam_from_world
        inverse_depth = state.inverse_depth + change[6 * T + F :].reshape(T, P)
        zoom = np.exp(change[6 * T : 6 * T + F]) * (np.ones(T) if state.zoom is None else state.zoom)
        return residuals(graph, State(poses, inverse_depth, state.focal_px, zoom)).ravel()

    columns = [(shifted(k, -step) - shifted(k, step)) / (2 * step) for k in range(6 * T + F + T * P)]
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module", params=[None, (0.9, 1.05, 1.2)], ids=["one focal length", "one per frame"])
def tiny(request: pytest.FixtureRequest) -> tuple[FlowGraph, State]:
    """Three frames with a dozen pixels each, and a state off the truth."""
    scene = make_scene(T=3, size=(24, 32))
    graph = observe(scene, offsets=(1, 2), stride=8, noise_px=0.3)
    weights = np.random.default_rng(1).uniform(0.1, 1, graph.weights.shape).astype(np.float32)
    zoom = None if request.param is None else np.array(request.param)
    return replace(graph, weights=weights), replace(disturbed(true_state(scene, graph)), zoom=zoom)


def edge_derivatives(graph: FlowGraph, state: State, e: int) -> tuple[np.ndarray, ...]:
    """Derivatives [P, 2, n] of the projections of one edge, in plain numpy.

    By the left twists of the target and of the source (6 each), the log focal lengths of the target and of the source
    and the inverse depth (1 each).
    """
    i, j = graph.source[e], graph.target[e]
    relative = state.cam_from_world[j] @ np.linalg.inv(state.cam_from_world[i])
    R, t, f, d = relative[:3, :3], relative[:3, 3], state.focals_px[j], state.inverse_depth[i]
    rays = np.concatenate([(graph.pixels - graph.centre) / state.focals_px[i], np.ones((len(d), 1))], axis=1)
    points = rays @ R.T + d[:, None] * t
    X, Y, Z = points.T
    by_point = np.zeros((len(d), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = f / Z
    by_point[:, 0, 2], by_point[:, 1, 2] = -f * X / Z**2, -f * Y / Z**2
    shift = d[:, None, None] * np.eye(3)
    by_target = by_point @ np.concatenate([shift, -lie.skew(points)], axis=2)
    by_source = by_point @ -R @ np.concatenate([shift, -lie.skew(rays)], axis=2)
    by_lens_there = f * np.stack([X / Z, Y / Z], axis=1)[:, :, None]
    by_lens_here = by_point @ (-(rays * [1, 1, 0]) @ R.T)[:, :, None]
    return by_target, by_source, by_lens_there, by_lens_here, by_point @ np.broadcast_to(t[:, None], (len(d), 3, 1))


def dense_jacobian(graph: FlowGraph, state: State) -> np.ndarray:
    """Derivative [2 E P, 6 T + F + T P] of the projections by (twists, F log focals, inverse depths)."""
    T, P = state.inverse_depth.shape
    F = 1 if state.zoom is None else T
    J = np.zeros((len(graph.source), P, 2, 6 * T + F + T * P))
    for e, (i, j) in enumerate(zip(graph.source, graph.target, strict=True)):
        by_target, by_source, by_lens_there, by_lens_here, by_depth = edge_derivatives(graph, state, e)
        J[e, :, :, 6 * j : 6 * j + 6], J[e, :, :, 6 * i : 6 * i + 6] = by_target, by_source
        J[e, :, :, 6 * T + j % F] += by_lens_there[:, :, 0]
        J[e, :, :, 6 * T + i % F] += by_lens_here[:, :, 0]
        J[e, np.arange(P), :, 6 * T + F + P * i + np.arange(P)] = by_depth[:, :, 0]
    return J.reshape(-1, J.shape[-1])


def test_derivatives_are_those_of_finite_differences(tiny: tuple[FlowGraph, State]) -> None:
    numeric = numeric_jacobian(*tiny)
    assert_allclose(dense_jacobian(*tiny), numeric, atol=1e-7 * np.abs(numeric).max())


def at_infinity(graph: FlowGraph, state: State) -> tuple[FlowGraph, State]:
    """The state with most inverse depths at the lower limit, near it and above it; its residuals are noise."""
    rng = np.random.default_rng(4)
    values = [BEYOND_INFINITY, 0.95 * BEYOND_INFINITY, 0.5 * BEYOND_INFINITY, state.inverse_depth]
    state = replace(state, inverse_depth=np.choose(rng.choice(4, state.inverse_depth.shape), values))
    noise = 0.3 * rng.standard_normal(graph.matches.shape)
    return replace(graph, matches=(graph.matches - residuals(graph, state) + noise).astype(np.float32)), state


@pytest.mark.parametrize("case", ["within the limits", "at infinity", "at infinity, not masked"])
def test_the_reduced_system_and_its_depths_equal_a_dense_reference_to_1e_9(
    tiny: tuple[FlowGraph, State], case: str
) -> None:
    graph, state = replace(tiny[0], masked="not" not in case), tiny[1]
    if case != "within the limits":
        graph, state = at_infinity(graph, state)
    sigma, damping = 1.5, 1e-2
    J, r = dense_jacobian(graph, state), residuals(graph, state)
    robust = graph.weights / (1 + (r**2).sum(-1) / sigma**2) ** 2
    W = np.repeat(robust.ravel(), 2)
    H, g = J.T @ (J * W[:, None]), J.T @ (W * r.ravel())
    zoom = state.zoom is not None
    n = 7 * graph.T if zoom else 6 * graph.T + 1
    depths = slice(n, None)
    # The depth prior and the damping of the depths, as the solver has them.
    H[depths, depths] += DEPTH_PRIOR * np.eye(H.shape[0] - n)
    H[depths, depths] *= 1 + damping * np.eye(H.shape[0] - n)
    g[depths] += DEPTH_PRIOR * (1 - state.inverse_depth.ravel())
    # Depths at the limit, or near it, that are drawn beyond it stay there.
    held = graph.masked & (state.inverse_depth.ravel() < 0.9 * BEYOND_INFINITY) & (g[depths] < 0)
    assert held.any() == (case == "at infinity")
    H[depths, :n][held], g[depths][held] = 0, 0
    S = H[:n, :n] - H[:n, depths] @ np.linalg.solve(H[depths, depths], H[depths, :n])
    rhs = g[:n] - H[:n, depths] @ np.linalg.solve(H[depths, depths], g[depths])

    data, at = arguments.observations(graph), arguments.geometry(graph, state)
    hessians, schur, curvatures, gradients = normal_equations(data, at, sigma, damping, DEPTH_PRIOR, zoom)
    relative = reduced.relative_motions(graph, state.cam_from_world)
    S_ours, rhs_ours = assembled(graph, relative, hessians, schur)
    unit = np.sqrt(np.diagonal(H)[:n])
    assert_allclose(S_ours / np.outer(unit, unit), S / np.outer(unit, unit), atol=1e-9)
    assert_allclose(rhs_ours / unit, rhs / unit, atol=1e-9 * np.abs(rhs / unit).max())
    step = np.random.default_rng(2).standard_normal(n)
    local = reduced.edge_steps(graph, relative, step)
    depth_step = depth_steps(data, at, sigma, curvatures, gradients, local)
    expected = np.linalg.solve(H[depths, depths], g[depths] - H[depths, :n] @ step).reshape(depth_step.shape)
    assert_allclose(depth_step, expected, atol=1e-9 * np.abs(expected).max())


def test_local_systems_equal_a_plain_numpy_reference_to_1e_9() -> None:
    scene = make_scene(T=4, size=(40, 56))
    graph = observe(scene, stride=3, noise_px=0.2)
    # Weights that float32 cannot take the root of exactly.
    weights = np.random.default_rng(1).uniform(0.1, 1, graph.weights.shape).astype(np.float32)
    graph, state = replace(graph, weights=weights), disturbed(true_state(scene, graph))
    hessians, *_ = normal_equations(arguments.observations(graph), arguments.geometry(graph, state), 0.7, 0.0, 0.0)
    for e in range(len(graph.source)):
        by_target, _, by_lens_there, by_lens_here, _ = edge_derivatives(graph, state, e)
        r = residuals(graph, state)[e]
        J = np.concatenate([by_target, by_lens_there + by_lens_here, r[:, :, None]], axis=2)
        robust = graph.weights[e] / (1 + (r**2).sum(-1) / 0.7**2) ** 2
        expected = np.einsum("pca,p,pcb->ab", J, robust, J)
        assert_allclose(hessians[e], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_gradient_is_that_of_the_robust_cost(tiny: tuple[FlowGraph, State]) -> None:
    graph, state = tiny
    data, at = arguments.observations(graph), arguments.geometry(graph, state)
    T, zoom = graph.T, state.zoom is not None
    hessians, schur, *_ = normal_equations(data, at, 2.0, 0.0, DEPTH_PRIOR, zoom)
    relative = reduced.relative_motions(graph, state.cam_from_world)
    _, gradient = assembled(graph, relative, hessians, np.zeros_like(schur))
    total = float(graph.weights.sum(dtype=float))

    def cost(step: np.ndarray) -> float:
        poses = lie.exp_se3(step[: 6 * T].reshape(-1, 6)) @ state.cam_from_world
        moved = State(
            poses, state.inverse_depth, state.focal_px, np.exp(step[6 * T :]) * state.focals_px / state.focal_px
        )
        r2 = (residuals(graph, moved) ** 2).sum(-1) / 4.0
        return 4.0 * float((graph.weights * (r2 / (1 + r2))).sum())

    steps = 1e-5 * np.eye(len(gradient))
    numeric = np.array([(cost(step) - cost(-step)) / 2e-5 for step in steps])
    assert_allclose(-2 * gradient, numeric, atol=1e-5 * np.abs(numeric).max())
    assert dba.robust_cost(graph, dba.errors_px(graph, state), 2.0) == pytest.approx(
        cost(0 * steps[0]) / total, rel=1e-5
    )


@pytest.mark.parametrize("disc_radius", [0.0, 0.6])
def test_exact_flow_and_masks_give_the_trajectory_within_a_tenth_of_a_percent(disc_radius: float) -> None:
    scene = make_scene(size=(96, 160), disc_radius=disc_radius)
    solution = estimate(Problem(observe(scene), masked=True), OPTIONS)
    assert solution.camera == "moving"
    assert solution.focal["decision"] == "estimated"
    assert solution.flags == []
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 1e-3
    assert rotation_error_deg(solution.state.cam_from_world, scene.cam_from_world) < 0.01
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.005)


def test_masks_lower_the_error_of_a_scene_with_a_mover() -> None:
    scene = make_scene(size=(96, 160), disc_radius=1.2)
    errors = {}
    for masked in (True, False):
        graph = observe(scene, masked=masked, noise_px=0.1)
        solution = estimate(Problem(graph, masked, known_focal_px=scene.focal_px), OPTIONS)
        errors[masked] = trajectory_error(solution.state.cam_from_world, scene.cam_from_world)
    assert errors[True] < 0.5 * errors[False]
    assert errors[True] < 2e-3


def test_the_result_does_not_depend_on_the_gauge_of_the_start() -> None:
    scene = make_scene()
    graph = observe(scene, noise_px=0.1)
    start = disturbed(true_state(scene, graph), 0.02)
    moved = start.cam_from_world @ lie.exp_se3(np.array([3.0, -2.0, 1.0, 0.5, -1.0, 2.0]))
    moved[:, :3, 3] *= 50.0
    other = State(moved, start.inverse_depth / 50.0, start.focal_px)
    prior = FocalPrior(1.1 * graph.width)
    levels = (Level(2.0, 20), Level(0.5, 60))
    solutions = [dba.solve(graph, s, levels, Unknowns(focal=True), prior, "test")[0] for s in (start, other)]
    assert_allclose(solutions[0].cam_from_world, solutions[1].cam_from_world, atol=1e-8)
    assert solutions[0].focal_px == pytest.approx(solutions[1].focal_px, rel=1e-8)
    assert_allclose(solutions[0].cam_from_world[0], np.eye(4), atol=1e-12)
    assert np.median(solutions[0].inverse_depth) == pytest.approx(1.0)


def test_steps_that_raise_the_cost_are_refused_and_damped() -> None:
    """From poses far off the full step overshoots."""
    scene = make_scene(disc_radius=0.8)
    graph = observe(scene, masked=False, noise_px=0.2)
    start = disturbed(true_state(scene, graph), 1.0)
    found, steps = dba.solve(graph, start, (Level(1.0, 30),), Unknowns(focal=True), FocalPrior(100.0), "test")
    accepted, costs, damping = (np.array([getattr(s, name) for s in steps]) for name in ("accepted", "cost", "damping"))
    assert accepted.any()
    assert not accepted.all()
    assert (np.diff(costs) <= 0).all()
    assert_allclose(np.diff(costs)[~accepted[1:]], 0)
    assert ((np.diff(damping) > 0) == ~accepted[1:]).all()
    assert dba.robust_cost(graph, dba.errors_px(graph, found), 1.0) <= costs[-1]


def test_covariance_predicts_the_scatter_of_noisy_solutions() -> None:
    scene = make_scene(T=5, size=(48, 72))
    prior, unknowns, noise_px = FocalPrior(scene.focal_px, 1e6), Unknowns(focal=True), 0.05
    solutions = []
    for seed in range(24):
        # An odd stride samples single pixels, so that their noise is not averaged.
        graph = observe(scene, stride=3, noise_px=noise_px, seed=seed)
        start = true_state(scene, graph)
        state, _ = dba.solve(graph, start, (Level(5.0, 20),), unknowns, prior, "test")
        size = np.linalg.norm(state.cam_from_world[:, :3, 3])
        state.cam_from_world[:, :3, 3] /= size
        solutions.append(np.append(lie.log_se3(state.cam_from_world)[1:].ravel(), np.log(state.focal_px)))
    graph = observe(scene, stride=3)
    system = linear_system(graph, dba.normalise(true_state(scene, graph)), 5.0, unknowns)
    assert isinstance(system, DenseSystem)
    predicted = system.covariance().full
    rotation = [6 * k + a for k in range(1, graph.T) for a in (3, 4, 5)]
    sigma = noise_px * np.sqrt(np.diag(predicted)[[*rotation, -1]])
    scatter = np.std(np.stack(solutions), axis=0)[[*(index - 6 for index in rotation), -1]]
    assert_allclose(scatter / sigma, 1.0, atol=0.5)
