"""Hard cases of the banded reduced system: each against the dense one, which is the oracle."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import cho_solve_banded, cholesky_banded
from synthetic import make_scene, observe

from stages.ba import band_layout, dba, proposal
from stages.ba.band_layout import layout
from stages.ba.band_solve import backward, forward
from stages.ba.banded_system import BandedSystem
from stages.ba.graph import FlowGraph
from stages.ba.state import FocalPrior, State, Unknowns
from stages.shared import lie

T = 24
PRIOR = FocalPrior(100.0)
ZOOM = Unknowns(focal=True, zoom=True)


@pytest.fixture(autouse=True)
def _no_dense_default() -> Iterator[None]:
    before = proposal.DENSE_FRAMES, proposal.RIDGE_OF_LONG
    proposal.RIDGE_OF_LONG = proposal.RIDGE
    yield
    proposal.DENSE_FRAMES, proposal.RIDGE_OF_LONG = before


@pytest.fixture(scope="module")
def path() -> tuple[FlowGraph, State]:
    """A camera along a path: edges between near frames alone."""
    scene = make_scene(T=T, size=(32, 48), travel=0.4)
    graph = observe(scene, offsets=(1, 2, 4), stride=4, noise_px=0.1)
    depth = 1 / graph.resample(scene.depth, 1)
    random = np.random.default_rng(0)
    poses = lie.exp_se3(0.01 * random.standard_normal((T, 6))) @ scene.cam_from_world
    return graph, dba.normalise(State(poses, depth, 1.02 * scene.focal_px))


def loops(graph: FlowGraph, pairs: list[tuple[int, int]]) -> FlowGraph:
    """The graph with more edges, both ways, whose matches are those of edges that leave the same frames."""
    extra = [(i, j) for a, b in pairs for i, j in ((a, b), (b, a))]
    source = np.append(graph.source, [i for i, _ in extra])
    target = np.append(graph.target, [j for _, j in extra])
    order = np.lexsort((target, source))
    like = np.append(np.arange(len(graph.source)), [graph.pointer[i] for i, _ in extra])[order]
    pointer = np.searchsorted(source[order], np.arange(graph.T + 1))
    arrays = {"matches": graph.matches[like], "weights": graph.weights[like]}
    return replace(graph, source=source[order], target=target[order], pointer=pointer, **arrays)


def blinded(graph: FlowGraph, edges: np.ndarray, weight: float) -> FlowGraph:
    return replace(graph, weights=np.where(edges[:, None], np.float32(weight) * graph.weights, graph.weights))


def both_steps(graph: FlowGraph, state: State, unknowns: Unknowns, damping: float = 1e-4) -> list[State]:
    found = []
    for frames in (100, 0):
        proposal.DENSE_FRAMES = frames
        proposed, _ = proposal.propose(graph, state, 1.0, damping, unknowns, PRIOR)
        assert proposed is not None
        found.append(proposed)
    return found


def assert_same_step(graph: FlowGraph, state: State, unknowns: Unknowns, rtol: float = 1e-10, **kwargs: float) -> None:
    dense, banded = both_steps(graph, state, unknowns, **kwargs)
    scale = np.abs(dense.cam_from_world - state.cam_from_world).max()
    assert scale > 0
    assert_allclose(banded.cam_from_world, dense.cam_from_world, atol=rtol * max(scale, 1))
    assert_allclose(banded.focals_px, dense.focals_px, rtol=rtol)
    assert_allclose(banded.inverse_depth, dense.inverse_depth, atol=10 * rtol)


@pytest.mark.parametrize("unknowns", [Unknowns(), Unknowns(focal=True), Unknowns(focal=True, translation=False), ZOOM])
def test_the_step_is_that_of_the_dense_system(path: tuple[FlowGraph, State], unknowns: Unknowns) -> None:
    assert_same_step(*path, unknowns)


def test_so_is_the_step_behind_a_lens(path: tuple[FlowGraph, State]) -> None:
    graph, state = path
    state = replace(state, lens=np.array([0.02, -0.01]))
    for free in (1, 2):
        assert_same_step(graph, state, Unknowns(focal=True, lens=free))


@pytest.mark.parametrize("unknowns", [Unknowns(focal=True), ZOOM])
def test_loop_edges_are_part_of_the_band(path: tuple[FlowGraph, State], unknowns: Unknowns) -> None:
    """A band along time would leave them out, or be as wide as the sequence is long."""
    graph = loops(path[0], [(k, T - 1 - k) for k in range(4)])
    assert_same_step(graph, path[1], unknowns)
    size = 6 * T + (T if unknowns.zoom else 1)
    width = layout(graph, size, unknowns.indices(T), unknowns.zoom).width
    assert width < 0.85 * size


@pytest.mark.parametrize("unknowns", [Unknowns(focal=True), ZOOM, Unknowns(focal=True, translation=False)])
def test_the_ends_of_few_loops_stand_in_the_border(
    path: tuple[FlowGraph, State], unknowns: Unknowns, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a path that returns again and again no order has a narrow band; frame 0, which is held, is an end too."""
    monkeypatch.setattr(band_layout, "REACH", 6)
    graph = loops(path[0], [(0, 8), (0, 16), (8, 16), (8, T - 1)])
    at = layout(graph, 6 * T + (T if unknowns.zoom else 1), unknowns.indices(T), unknowns.zoom)
    assert set(np.arange(T)) - set(at.frame) == {0, 8, 16, T - 1}
    assert at.first.tolist() == sorted(at.first)
    assert_same_step(graph, path[1], unknowns)
    assert_covariances_agree(graph, path[1], unknowns)


def test_where_every_frame_is_the_end_of_a_loop_none_is_apart(
    path: tuple[FlowGraph, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera turns round and round: with all of its frames in the border no band would be left to be factored."""
    graph = loops(path[0], [(k, k + T // 2) for k in range(T // 2)])
    for reach in (6, 0):
        monkeypatch.setattr(band_layout, "REACH", reach)
        at = layout(graph, 6 * T + 1, Unknowns(focal=True).indices(T), False)
        assert (at.band, at.border) == (6 * (T - 1), 1)
        assert_same_step(graph, path[1], Unknowns(focal=True))


@pytest.mark.parametrize("n", [1, 7, 12, 30])
@pytest.mark.parametrize("width", [1, 4, 12])
def test_substitution_of_many_sides_is_that_of_one_after_the_other(n: int, width: int) -> None:
    random = np.random.default_rng(n + width)
    K = np.asfortranarray(random.uniform(-1, 1, (width + 1, n)))
    K[0] = 2 * width + 2
    L = cholesky_banded(K, lower=True)
    first = np.sort(random.integers(0, n + 1, 9))
    sides = np.where(np.arange(n)[:, None] >= first, random.standard_normal((n, 9)), 0)
    dense = np.array([[L[i - j, j] if 0 <= i - j <= width else 0 for j in range(n)] for i in range(n)])
    assert_allclose(dense @ forward(L, sides, first), sides, atol=1e-13)
    assert_allclose(forward(L, sides), forward(L, sides, first), atol=1e-13)
    assert_allclose(backward(L, forward(L, sides)), cho_solve_banded((L, True), sides), atol=1e-13)


def test_loops_all_over_the_place_are_solved_too(path: tuple[FlowGraph, State]) -> None:
    random = np.random.default_rng(0)
    pairs = {(int(i), int(j)) for i, j in np.sort(random.integers(0, T, (30, 2)), axis=1) if j > i + 4}
    assert_same_step(loops(path[0], sorted(pairs)), path[1], Unknowns(focal=True))


def test_frames_without_matches_neither_move_nor_disturb(path: tuple[FlowGraph, State]) -> None:
    graph, state = path
    for blind in (0, 11, T - 1):
        hidden = blinded(graph, (graph.source == blind) | (graph.target == blind), 0.0)
        assert_same_step(hidden, state, Unknowns(focal=True))
        assert_same_step(hidden, state, ZOOM)


def test_two_parts_joined_by_one_weak_edge(path: tuple[FlowGraph, State]) -> None:
    """Pinned at a single frame, the scale of the other part would hang on the weak edge alone."""
    graph, state = path
    across = (graph.source < 12) != (graph.target < 12)
    bridge = (graph.source == 11) & (graph.target == 12)
    weak = blinded(blinded(graph, across & ~bridge, 0.0), bridge, 1e-3)
    assert_same_step(weak, state, Unknowns(focal=True), rtol=1e-8, damping=1e-7)
    assert_covariances_agree(weak, state, Unknowns(focal=True), rtol=1e-3)


def test_nearly_undamped_the_scale_is_fixed_along_the_whole_path(path: tuple[FlowGraph, State]) -> None:
    """By the formula of Woodbury alone, without the pin, the band is singular in scale and the step noise."""
    assert_same_step(*path, Unknowns(), rtol=1e-9, damping=1e-12)


def test_a_focal_length_that_is_not_observable(path: tuple[FlowGraph, State]) -> None:
    """No match has weight off the middle of the image, where the focal length shows: its curvature is all but zero."""
    graph, state = path
    middle = np.abs(graph.pixels - graph.centre).max(axis=1) < 5
    narrow = replace(graph, weights=graph.weights * middle.astype(np.float32))
    for unknowns in (Unknowns(focal=True), ZOOM):
        assert_same_step(narrow, state, unknowns, rtol=1e-7, damping=1e-7)


def test_no_match_at_all_is_no_step(path: tuple[FlowGraph, State]) -> None:
    graph, state = path
    empty = blinded(graph, np.ones(len(graph.source), bool), 0.0)
    for found in both_steps(empty, state, Unknowns(), 1e-3):
        assert_allclose(found.cam_from_world, state.cam_from_world)


def assert_covariances_agree(graph: FlowGraph, state: State, unknowns: Unknowns, rtol: float = 1e-6) -> None:
    found = []
    for frames in (100, 0):
        proposal.DENSE_FRAMES = frames
        system = proposal.linear_system(graph, state, 0.5, unknowns)
        assert isinstance(system, BandedSystem) == (frames == 0)
        covariance, size = system.covariance(), len(system.diagonal)
        found.append((covariance.poses(T), covariance.of(np.eye(size)[6 * T :])))
    for dense, banded in zip(*found, strict=True):
        assert_allclose(banded, dense, rtol=rtol, atol=rtol * np.abs(dense).max())


@pytest.mark.parametrize("unknowns", [Unknowns(), Unknowns(focal=True), ZOOM, Unknowns(focal=True, translation=False)])
def test_the_covariance_is_that_of_the_dense_system(path: tuple[FlowGraph, State], unknowns: Unknowns) -> None:
    assert_covariances_agree(*path, unknowns)
    assert_covariances_agree(loops(path[0], [(0, T - 1), (1, T - 3)]), path[1], unknowns)


def test_the_covariance_of_a_frame_without_matches_is_large_and_finite(path: tuple[FlowGraph, State]) -> None:
    graph, state = path
    hidden = blinded(graph, (graph.source == 9) | (graph.target == 9), 0.0)
    proposal.DENSE_FRAMES = 0
    poses = proposal.linear_system(hidden, state, 0.5, Unknowns(focal=True)).covariance().poses(T)
    assert np.isfinite(poses).all()
    seen = np.arange(T) != 9
    assert poses[9, 0, 0] > 1e3 * poses[seen, 0, 0].max()
