"""Depth of what moves: it stands where it touches the ground, comes nearer as it grows, and keeps both over a clip."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, make_scene, observe

from stages.ba import growth
from stages.ba.depth import DepthMaps, dynamic_pixels, fill
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.growth import Links, link_regions, number_regions
from stages.ba.mover_depth import CUT_OFF, Contact, consistent, contact_inverse_depth, placed

STRIDE = 2
SIZE = (96, 160)


def leaving(**options: object) -> Scene:
    """A disc on the floor that goes away: the image first cuts off its lower part, and later shows its contact."""
    return make_scene(T=10, size=SIZE, disc_radius=0.8, velocity=(0.05, 0.0, 0.3), motion="still", **options)


def followed(scene: Scene, noise_px: float = 0.1) -> tuple[FlowGraph, np.ndarray, Links]:
    """The unmasked matches, the regions of the disc and their links."""
    graph = observe(scene, stride=STRIDE, masked=False, noise_px=noise_px)
    numbers = number_regions(dynamic_pixels((~scene.dynamic).astype(np.int8), STRIDE))
    return graph, numbers, link_regions(graph, numbers)


def of_cells(scene: Scene) -> np.ndarray:
    """True inverse depth [T, rows, columns]."""
    return 1 / scene.depth[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]


def region_depths(inverse_depth: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Log of the median inverse depth of each region, from 1 on."""
    return np.log([np.median(inverse_depth[numbers == k]) for k in range(1, numbers.max() + 1)])


@pytest.mark.parametrize("zoom", [None, np.linspace(1.0, 1.3, 10)])
def test_a_region_grows_as_its_inverse_depth_does(zoom: np.ndarray | None) -> None:
    scene = leaving(zoom=zoom)
    _, numbers, links = followed(scene)
    frames = [int(np.flatnonzero((numbers == k).any(axis=(1, 2)))[0]) for k in range(1, numbers.max() + 1)]
    sizes = region_depths(of_cells(scene), numbers) + (0.0 if zoom is None else np.log(zoom[frames]))
    assert len(links.gap) >= 2 * 9
    expected = sizes[links.target - 1] - sizes[links.source - 1]
    assert_allclose(links.log_growth, expected, atol=0.03)
    assert (np.abs(expected) > 0.06).any()


@pytest.mark.parametrize("zoom", [None, np.linspace(1.0, 1.1, 10)])
def test_what_shows_its_feet_later_stands_there_from_the_beginning(zoom: np.ndarray | None) -> None:
    """Frame by frame what the image cuts off would stand before the ground at the edge, and jump when it is seen."""
    scene = leaving(zoom=zoom)
    _, numbers, links = followed(scene)
    truth, moving = of_cells(scene), numbers > 0
    blind = np.stack([fill(*frame) for frame in zip(truth, moving, strict=True)])
    maps = placed(DepthMaps(blind, np.ones(truth.shape), moving), numbers, links, np.ones(10) if zoom is None else zoom)
    errors = region_depths(maps.inverse_depth, numbers) - region_depths(truth, numbers)
    assert np.abs(errors).max() < 0.12
    assert np.ptp(errors) < 0.03
    alone = [contact_inverse_depth(numbers[k] == k + 1, truth[k], ~moving[k]) for k in range(10)]
    assert {kind for _, kind in alone} == {Contact.FEET, Contact.EDGE}
    each = np.log([value * (CUT_OFF if kind == Contact.EDGE else 1.0) for value, kind in alone])
    each -= region_depths(truth, numbers)
    assert np.ptp(each) > 0.2
    assert_allclose(maps.inverse_depth[~moving], truth[~moving])


def chain(growth: np.ndarray) -> Links:
    """Links of regions 0..n, each to the next."""
    n = len(growth)
    every = np.ones(n, int)
    return Links(np.arange(n), np.arange(1, n + 1), every, growth, np.full(n, 1e-3), 100 * every)


def test_what_leaves_the_ground_is_where_it_touches_it() -> None:
    """A ball that touches the ground in three of ten frames; in the others ground farther away is seen beneath it."""
    truth = np.linspace(0.0, 0.9, 10)
    contact = truth - 0.5
    contact[[0, 5, 9]] = truth[[0, 5, 9]]
    found = consistent(contact, np.full(10, Contact.FEET), np.full(10, 100.0), chain(np.diff(truth)))
    assert np.abs(found - truth).max() < 0.05
    assert np.abs(np.median(contact - truth)) == pytest.approx(0.5)


def test_what_is_always_cut_off_stands_before_the_ground_beside_it_and_keeps_its_growth() -> None:
    truth = np.linspace(0.0, 0.9, 10)
    contact = truth - 0.47 + 0.1 * np.where(np.arange(10) % 2, 1, -1)
    kind = np.full(10, Contact.EDGE)
    found = consistent(contact, kind, np.full(10, 100.0), chain(np.diff(truth)))
    assert_allclose(np.diff(found), np.diff(truth), atol=0.03)
    assert np.abs(found - truth).max() < 0.12
    kind[4], contact[4] = Contact.AROUND, -2.0  # for once it spans the lower edge: what surrounds it is far behind
    assert np.abs(consistent(contact, kind, np.full(10, 100.0), chain(np.diff(truth))) - truth).max() < 0.12


def test_what_is_seen_to_stand_is_not_behind_the_ground_that_cuts_it_off_elsewhere() -> None:
    truth = np.linspace(0.0, 0.9, 10)
    contact, cut = truth - 0.6, np.arange(10) >= 5  # in the air: behind it, ground is seen
    contact[cut] = truth[cut] - 0.1
    kind = np.where(cut, Contact.EDGE, Contact.FEET)
    found = consistent(contact, kind, np.full(10, 100.0), chain(np.diff(truth)))
    assert (found >= contact - 0.05)[cut].all()
    behind = np.where(cut, truth - 0.9, truth)  # ground beside it is far behind: that it is before this says nothing
    standing = consistent(behind, kind, np.full(10, 100.0), chain(np.diff(truth)))
    assert np.abs(standing - truth).max() < 0.05


def test_what_has_no_measured_ground_is_not_behind_what_it_hides() -> None:
    truth = np.linspace(0.0, 0.9, 10)
    found = consistent(truth - 0.2, np.full(10, Contact.AROUND), np.full(10, 100.0), chain(np.diff(truth)))
    assert_allclose(found, truth - 0.2, atol=0.01)


def crossing(T: int = 20) -> tuple[FlowGraph, np.ndarray, np.ndarray]:
    """Two upright things that pass before one another, near and far: matches, regions, true inverse depth of cells."""
    h, w, focal_px, horizon = 48, 80, 70.0, 20
    y, x = np.mgrid[:h, :w]
    inverse_depth = np.repeat(np.clip((y - horizon) / focal_px, 1e-3, None)[None], T, axis=0)
    depths, labels = (7.0, 3.0), np.zeros((T, h, w), int)
    centres = np.outer(np.linspace(-1, 1, T), (-2.6, 1.4))
    for k in range(T):
        for thing, depth in enumerate(depths):
            across, below = (x - w / 2) / focal_px * depth - centres[k, thing], (y - horizon) / focal_px * depth
            covered = (np.abs(across) < 0.3) & (below < 1) & (below > -0.2)
            labels[k][covered], inverse_depth[k][covered] = thing + 1, 1 / depth
    edges = [(i, i + gap) for i in range(T) for gap in (-5, -3, -2, -1, 1, 2, 3, 5) if 0 <= i + gap < T]
    flow, seen = np.zeros((len(edges), h, w, 2), np.float32), np.zeros((len(edges), h, w), np.float32)
    for e, (i, j) in enumerate(edges):
        for thing, depth in enumerate(depths):
            flow[e, labels[i] == thing + 1, 0] = focal_px * (centres[j, thing] - centres[i, thing]) / depth
        u = np.clip(np.rint(x + flow[e, ..., 0]).astype(int), 0, w - 1)
        seen[e] = labels[j][y, u] == labels[i]
    source, target = np.array(edges).T
    noisy = flow + 0.1 * np.random.default_rng(0).standard_normal(flow.shape).astype(np.float32)
    graph = build_graph(source, target, noisy, seen, T, STRIDE)
    cells = np.s_[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    return graph, number_regions(labels[cells] > 0), inverse_depth[cells]


def test_things_that_pass_before_one_another_keep_their_own_depths() -> None:
    """As one region for a few frames, they would have one depth in all."""
    graph, numbers, truth = crossing()
    moving = numbers > 0
    assert min(len(np.unique(frame)) for frame in numbers) == 2
    blind = np.stack([fill(*frame) for frame in zip(truth, moving, strict=True)])
    links = link_regions(graph, numbers)
    maps = placed(DepthMaps(blind, np.ones(truth.shape), moving), numbers, links, np.ones(len(truth)))
    apart = np.array([len(np.unique(frame)) == 3 for frame in numbers])
    assert np.abs(np.log(maps.inverse_depth * (1 / truth)))[apart][moving[apart]].max() < 0.15


def test_a_graze_of_a_few_pixels_links_nothing() -> None:
    numbers = np.zeros((2, 20, 40), np.int32)
    numbers[0, 4:16, 4:16], numbers[1, 4:16, 4:16], numbers[1, 2:18, 24:36] = 1, 2, 3
    flow = np.zeros((1, 20, 40, 2), np.float32)
    flow[0, 4:7, 4:7, 0] = 20.0  # nine wrong matches
    graph = build_graph(np.array([0]), np.array([1]), flow, np.ones((1, 20, 40), np.float32), 2, 1)
    links = link_regions(graph, numbers)
    assert (links.source.tolist(), links.target.tolist(), links.pixels.tolist()) == ([1], [2], [135])


def test_growth_is_that_of_most_matches_and_its_deviation_that_of_their_noise() -> None:
    y, x = np.mgrid[:40, :40]
    numbers = np.zeros((2, 40, 40), np.int32)
    numbers[0, 10:30, 10:30], numbers[1, 4:36, 4:36] = 1, 2
    exact = 0.4 * np.stack([x - 19.5, y - 19.5], axis=-1)
    rng, ones = np.random.default_rng(1), np.ones((1, 40, 40), np.float32)

    def linked(flow: np.ndarray) -> Links:
        return link_regions(build_graph(np.array([0]), np.array([1]), flow[None], ones, 2, 1), numbers)

    found = [linked(exact + 0.3 * rng.standard_normal(exact.shape)) for _ in range(60)]
    growths = np.concatenate([links.log_growth for links in found])
    assert growths.mean() == pytest.approx(np.log(1.4), abs=2e-3)
    assert np.median([links.sigma for links in found]) == pytest.approx(growths.std(), rel=0.4)
    wrong = exact.copy()
    wrong[10:30, 10:14] = [6.0, 0.0]  # a fifth of the matches
    assert linked(wrong).log_growth == pytest.approx(np.log(1.4), abs=0.01)


def test_a_moving_object_stands_where_it_touches_the_ground() -> None:
    # Ground whose inverse depth grows downwards; far wall above; an object whose feet are at row 14.
    inverse_depth = np.where(np.arange(20) < 10, 0.1, 0.1 * (np.arange(20) - 8))[:, None] * np.ones((1, 24))
    region = np.zeros((20, 24), bool)
    region[4:15, 8:14] = True
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(0.7), Contact.FEET)
    region[4:, 8:14] = True  # the ground beside it has 1.0 and 1.1 in its last two rows
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(1.05), Contact.EDGE)
    measured = ~region & (np.arange(20) < 15)[:, None]  # no ground at the edge: what is around its head
    near_end, kind = contact_inverse_depth(region, inverse_depth, measured)  # most of it is 0.1, the nearest 0.6
    assert kind == Contact.AROUND
    assert 0.3 < near_end < 0.5
    region[-1] = False  # its feet are seen: it stands on row 19
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(1.1), Contact.FEET)


def test_holes_take_the_nearest_measured_depth() -> None:
    inverse_depth = np.arange(24.0).reshape(4, 6) + 1
    missing = np.zeros((4, 6), bool)
    missing[1, 2] = True
    filled = fill(inverse_depth, missing)
    assert filled[1, 2] in (inverse_depth[0, 2], inverse_depth[2, 2], inverse_depth[1, 1], inverse_depth[1, 3])
    assert_allclose(filled[~missing], inverse_depth[~missing])


def test_regions_are_linked_block_by_block_as_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = leaving()
    graph, numbers, at_once = followed(scene)
    assert len(graph.source) < growth.EDGES
    monkeypatch.setattr(growth, "EDGES", 7)
    parts = []
    for first, end in ((0, 4), (4, 10)):
        edges = slice(graph.pointer[first], graph.pointer[end])
        of_edges = {name: getattr(graph, name)[edges] for name in ("source", "target", "matches", "weights")}
        pointer = np.searchsorted(of_edges["source"], np.arange(11))
        parts.append(link_regions(replace(graph, **of_edges, pointer=pointer), numbers))
    for found, expected in zip(zip(*parts, strict=True), at_once, strict=True):
        assert_allclose(np.concatenate(found), expected)
