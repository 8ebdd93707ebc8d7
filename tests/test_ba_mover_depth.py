"""Depth of what moves: it stands where it touches the ground, comes nearer as it grows, and keeps both over a clip."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, make_scene, observe

from stages.ba.depth import DepthMaps, dynamic_pixels, fill
from stages.ba.graph import FlowGraph
from stages.ba.growth import Links, link_regions, number_regions
from stages.ba.mover_depth import CUT_OFF, consistent, contact_inverse_depth, placed

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
    assert {cut for _, cut in alone} == {True, False}
    each = np.log([value * (CUT_OFF if cut else 1.0) for value, cut in alone]) - region_depths(truth, numbers)
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
    found = consistent(contact, np.zeros(10, bool), np.full(10, 100.0), chain(np.diff(truth)))
    assert np.abs(found - truth).max() < 0.05
    assert np.abs(np.median(contact - truth)) == pytest.approx(0.5)


def test_what_is_always_cut_off_stands_before_the_ground_beside_it_and_keeps_its_growth() -> None:
    truth = np.linspace(0.0, 0.9, 10)
    contact = truth - np.log(CUT_OFF) + 0.1 * np.where(np.arange(10) % 2, 1, -1)
    found = consistent(contact, np.ones(10, bool), np.full(10, 100.0), chain(np.diff(truth)))
    assert_allclose(np.diff(found), np.diff(truth), atol=0.03)
    assert np.abs(found - truth).max() < 0.12


def test_what_is_seen_to_stand_is_not_behind_the_ground_that_cuts_it_off_elsewhere() -> None:
    truth = np.linspace(0.0, 0.9, 10)
    contact, cut = truth - 0.6, np.arange(10) >= 5  # in the air: behind it, ground is seen
    contact[cut] = truth[cut] - 0.1
    found = consistent(contact, cut, np.full(10, 100.0), chain(np.diff(truth)))
    assert (found >= contact - 0.05)[cut].all()
    standing = consistent(np.where(cut, truth - 0.3, truth), cut, np.full(10, 100.0), chain(np.diff(truth)))
    assert np.abs(standing - truth).max() < 0.05


def test_a_moving_object_stands_where_it_touches_the_ground() -> None:
    # Ground whose inverse depth grows downwards; far wall above; an object whose feet are at row 14.
    inverse_depth = np.where(np.arange(20) < 10, 0.1, 0.1 * (np.arange(20) - 8))[:, None] * np.ones((1, 24))
    region = np.zeros((20, 24), bool)
    region[4:15, 8:14] = True
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(0.7), False)
    region[4:, 8:14] = True  # the ground beside it has 1.0 and 1.1 in its last two rows
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(1.05), True)
    region[-1] = False  # its feet are seen: it stands on row 19
    assert contact_inverse_depth(region, inverse_depth, ~region) == (pytest.approx(1.1), False)


def test_holes_take_the_nearest_measured_depth() -> None:
    inverse_depth = np.arange(24.0).reshape(4, 6) + 1
    missing = np.zeros((4, 6), bool)
    missing[1, 2] = True
    filled = fill(inverse_depth, missing)
    assert filled[1, 2] in (inverse_depth[0, 2], inverse_depth[2, 2], inverse_depth[1, 1], inverse_depth[1, 3])
    assert_allclose(filled[~missing], inverse_depth[~missing])


def test_regions_are_linked_block_by_block_as_all_at_once() -> None:
    scene = leaving()
    graph, numbers, at_once = followed(scene)
    parts = []
    for first, end in ((0, 4), (4, 10)):
        edges = slice(graph.pointer[first], graph.pointer[end])
        of_edges = {name: getattr(graph, name)[edges] for name in ("source", "target", "matches", "weights")}
        pointer = np.searchsorted(of_edges["source"], np.arange(11))
        parts.append(link_regions(replace(graph, **of_edges, pointer=pointer), numbers))
    for found, expected in zip(zip(*parts, strict=True), at_once, strict=True):
        assert_allclose(np.concatenate(found), expected)
