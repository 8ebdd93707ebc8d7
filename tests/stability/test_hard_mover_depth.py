"""Depth of what moves where next to nothing tells it."""

import numpy as np
from numpy.testing import assert_allclose
from synthetic import make_scene, observe

from stages.ba.depth import DepthMaps
from stages.ba.growth import Links, link_regions, number_regions
from stages.ba.mover_depth import Contact, consistent, placed
from stages.ba.state import INVERSE_DEPTHS

NONE = Links(*np.zeros((3, 0), int), *np.zeros((2, 0)), np.zeros(0, int))


def moving(T: int = 3) -> np.ndarray:
    regions = np.zeros((T, 8, 12), bool)
    regions[:, 2:5, 3:7] = True
    return regions


def test_a_region_without_links_stands_by_its_own_contact() -> None:
    regions = moving()
    maps = DepthMaps(np.full(regions.shape, 0.5), np.ones(regions.shape), regions)
    assert_allclose(placed(maps, number_regions(regions), NONE, np.ones(3)).inverse_depth, 0.5, rtol=1e-6)


def test_frames_without_any_measured_pixel_follow_their_neighbours() -> None:
    regions, missing = moving(), moving()
    missing[1] = True
    numbers, pixels = (np.array([1, 2]), np.array([2, 3])), np.full(2, 12)
    links = Links(*numbers, np.ones(2, int), np.log([2.0, 2.0]), np.full(2, 0.01), pixels)
    depths = np.broadcast_to(np.array([0.25, 1.0, 1.0])[:, None, None], regions.shape)
    found = placed(DepthMaps(depths, np.ones(regions.shape), missing), number_regions(regions), links, np.ones(3))
    assert_allclose([found.inverse_depth[k, 3, 4] for k in range(3)], [0.25, 0.5, 1.0], rtol=0.02)


def test_nothing_measured_at_all_is_finite() -> None:
    regions = moving()
    maps = DepthMaps(np.ones(regions.shape), np.ones(regions.shape), np.ones(regions.shape, bool))
    assert_allclose(placed(maps, number_regions(regions), NONE, np.ones(3)).inverse_depth, 1.0)


def test_ground_at_infinity_is_no_logarithm_of_zero() -> None:
    regions = moving()
    maps = DepthMaps(np.zeros(regions.shape), np.ones(regions.shape), regions)
    found = placed(maps, number_regions(regions), NONE, np.ones(3)).inverse_depth[regions]
    assert np.isfinite(found).all()
    assert (found > 0).all()


def test_no_region_at_all_changes_nothing() -> None:
    maps = DepthMaps(np.full((2, 4, 4), 0.3), np.ones((2, 4, 4)), np.zeros((2, 4, 4), bool))
    assert placed(maps, np.zeros((2, 4, 4), np.int32), NONE, np.ones(2)) is maps


def test_contacts_of_vanishing_area_do_not_divide_by_zero() -> None:
    assert np.isfinite(consistent(np.zeros(3), np.full(3, Contact.FEET), np.zeros(3), NONE)).all()


def test_frames_in_which_nothing_moves_have_no_links() -> None:
    scene = make_scene(T=3, size=(24, 32))
    links = link_regions(observe(scene, masked=False), np.zeros((3, 6, 8), np.int32))
    assert all(len(values) == 0 for values in links)


def test_specks_elsewhere_do_not_tear_a_large_mover_from_its_growth() -> None:
    """Were contacts weighed by the plain mean area, five thousand specks would raise their weight above all growth."""
    rng, truth = np.random.default_rng(0), np.linspace(0.0, 0.9, 20)
    contact = np.concatenate([truth + 0.3 * rng.standard_normal(20), np.zeros(5000)])
    area = np.concatenate([np.full(20, 3000.0), np.full(5000, 2.0)])
    every = np.ones(19, int)
    links = Links(np.arange(19), np.arange(1, 20), every, np.diff(truth), np.full(19, 1e-3), 3000 * every)
    found = consistent(contact, np.full(5020, Contact.FEET), area, links)[:20]
    assert np.std(np.diff(found - truth)) < 0.01


def test_a_growth_beyond_all_bounds_stays_a_depth() -> None:
    regions = moving()
    maps = DepthMaps(np.full(regions.shape, 0.5), np.ones(regions.shape), regions)
    links = Links(np.array([1]), np.array([2]), np.ones(1, int), np.array([-50.0]), np.full(1, 0.01), np.full(1, 12))
    found = placed(maps, number_regions(regions), links, np.ones(3)).inverse_depth
    assert ((found >= INVERSE_DEPTHS[0]) & (found <= INVERSE_DEPTHS[1])).all()
