"""Colours at the borders of masks: they tell where those within and those around differ, and nothing else."""

import cv2
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from stages.segment import colours
from stages.segment.colours import BIN, CELL_PX, RARE, Learnt, learn
from stages.segment.refinement import smooth_along_edges
from stages.shared.images import REFERENCE_PX

H, W = 160, REFERENCE_PX


def ground(seed: int, colour: tuple[int, int, int]) -> np.ndarray:
    """Texture [H, W, 3] uint8 of spots around a colour, without edges that only borders have."""
    noise = np.random.default_rng(seed).normal(0, 60, (H, W, 3))
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 1.2) * 2 + colour, 0, 255).astype(np.uint8)


def thing() -> np.ndarray:
    """An ellipse [H, W] bool."""
    v, u = np.mgrid[:H, :W]
    return np.asarray(((u - 250) / 90) ** 2 + ((v - 80) / 45) ** 2 < 1)


def scene(colour: tuple[int, int, int] = (190, 90, 20)) -> np.ndarray:
    """A picture of the thing before ground of about (110, 120, 90)."""
    return np.where(thing()[..., None], ground(1, colour), ground(2, (110, 120, 90)))


def guess() -> np.ndarray:
    """Sureness [H, W] of a mask that lies 8 px to the right of the thing."""
    return cv2.GaussianBlur(np.roll(thing(), 8, axis=1).astype(np.float32), (0, 0), 3)


def overlap(found: np.ndarray) -> float:
    """Intersection over union with the thing."""
    return float((found & thing()).sum() / (found | thing()).sum())


def evidence(sure: np.ndarray, rgb: np.ndarray, *others: Learnt) -> np.ndarray:
    """What colours say of a frame, taught by itself and by others."""
    return colours.colour_evidence(sure, rgb, learn(sure, rgb), others)


def test_a_mask_beside_its_thing_is_moved_onto_it() -> None:
    """Edges of texture are as strong as those of the thing: smoothing along them alone leaves the mask beside it."""
    rgb, sure = scene(), guess()
    told = evidence(sure, rgb)
    assert overlap(sure > 0.5) < 0.9
    assert overlap(smooth_along_edges(sure, rgb, 1000.0, 3.0) > 0.5) < 0.9
    assert overlap(smooth_along_edges(sure, rgb, 1000.0, 3.0, None, told) > 0.5) > 0.95


def test_the_kernels_equal_histograms_read_one_by_one() -> None:
    """Splatting and slicing against numpy's and scipy's, node by node."""
    rgb, sure = scene()[40:90, 200:260], guess()[40:90, 200:260]
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    weights = np.dstack([sure > 0.5, sure <= 0.5]).astype(np.float32)
    v, u = np.mgrid[: rgb.shape[0], : rgb.shape[1]] / 20
    places = np.concatenate([np.stack([v, u]), np.moveaxis(lab / BIN, -1, 0)]).reshape(5, -1)
    size = np.array([int(of.max()) + 2 for of in places])
    grid, expected = np.zeros((size[:2].prod(), size[2:].prod(), 2), np.float32), np.zeros((*size, 2))
    totals, found = np.zeros((len(grid), 2), np.float32), np.zeros_like(weights)
    colours._splat(lab, np.zeros(3, int), weights, 1 / 20, size, grid, totals)
    below = places.astype(int)
    for corner in np.ndindex(2, 2, 2, 2, 2):
        upper = np.array(corner)[:, None]
        share = np.where(upper, places - below, 1 - places + below).prod(axis=0)
        np.add.at(expected, tuple(below + upper), share[:, None] * weights.reshape(-1, 2))
    np.testing.assert_allclose(grid.reshape(expected.shape), expected, atol=1e-3)
    np.testing.assert_allclose(totals, grid.sum(axis=1), rtol=1e-4)
    colours._slice(lab, np.zeros(3, int), np.ones(rgb.shape[:2], bool), 1 / 20, size, grid, totals, found)
    axes = [np.arange(n) for n in size]
    density = RegularGridInterpolator(axes, expected)(places.T)
    around = RegularGridInterpolator(axes[:2], expected.sum(axis=(2, 3, 4)))(places[:2].T)
    p, q = (density / np.maximum(around, 1e-6)).T
    np.testing.assert_allclose(found[..., 0].ravel(), (p - q) / (p + q + RARE), atol=2e-3)
    np.testing.assert_allclose(found[..., 1].ravel(), around.min(axis=1), rtol=1e-4)


def test_what_is_lost_here_is_not_denied_where_it_is_found_elsewhere() -> None:
    """The lower half of the thing has a colour of its own, and the mask of this frame holds the upper half alone."""
    lower = thing() & (np.arange(H)[:, None] > 80)
    rgb = np.where(lower[..., None], ground(3, (60, 80, 200)), scene())
    lost = (thing() & ~lower).astype(np.float32)
    near = lower & (cv2.distanceTransform(1 - lost.astype(np.uint8), cv2.DIST_L2, 3) > 3)
    found = learn(thing().astype(np.float32), rgb)
    assert evidence(lost, rgb)[near].mean() < -0.3
    assert evidence(lost, rgb, found, found)[near].mean() > 0.1


def test_a_frame_without_a_border_teaches_nothing() -> None:
    """Of what is lost there altogether, the colours would be said to be those of the ground."""
    none, every = np.zeros((H, W), np.float32), np.ones((H, W), np.float32)
    assert not any(learn(sure, scene()).weights.any() for sure in (none, every))
    weights = learn(guess(), scene()).weights
    assert weights[..., 0].any()
    assert weights[..., 1].any()


def test_colours_that_are_alike_tell_little() -> None:
    """A histogram of few pixels differs by chance; how well it tells those that it was learnt from is asked, too."""
    alike, apart = (np.abs(evidence(guess(), scene(colour))).max() for colour in ((110, 120, 90), (190, 90, 20)))
    assert alike < 0.5, "with its weight of 2 it outvotes nothing that is sure"
    assert apart > 0.6


@pytest.mark.parametrize("mask", [np.zeros((H, W)), np.ones((H, W)), np.full((H, W), 0.5)])
def test_a_mask_of_nothing_or_all_has_no_border(mask: np.ndarray) -> None:
    assert not evidence(mask.astype(np.float32), scene()).any()


def test_what_is_thin_is_left_to_other_evidence() -> None:
    """Nothing of it is far enough from the border to be learnt: no colour is said to be that of the ground."""
    bar = np.zeros((H, W), np.float32)
    bar[78:82] = 1
    assert not evidence(bar, scene()).any()


@pytest.mark.parametrize("darkest", [0, 200])
def test_the_grid_holds_every_place_and_colour(darkest: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled loops check no bounds; here they run as plain Python, and every axis is checked."""
    corners = colours._corners.py_func

    def checked(place: tuple[float, ...], nodes: np.ndarray, at: np.ndarray, shares: np.ndarray) -> None:
        assert all(0 <= of < n - 1 for of, n in zip(place, nodes, strict=True))
        corners(place, nodes, at, shares)

    monkeypatch.setattr(colours, "_corners", checked)
    for name in ("_splat", "_slice"):
        monkeypatch.setattr(colours, name, getattr(colours, name).py_func)
    rgb = np.random.default_rng(0).integers(darkest, 256, (24, 40, 3)).astype(np.uint8)
    rgb[-1, -1], rgb[0, 0] = 255, darkest
    mask = np.zeros((24, 40), np.float32)
    mask[:, 20:] = 1
    others = [learn(mask, np.full_like(rgb, level)) for level in (0, 255)]
    assert np.isfinite(evidence(mask, rgb, *others)).all()


@pytest.mark.parametrize("bar", [np.s_[60:100, 352:358], np.s_[76:84, 350:358]])
def test_what_is_thin_or_small_beside_a_larger_mover_is_not_denied(bar: tuple[slice, slice]) -> None:
    """It has the colour of the ground, and nothing of it is learnt: without more, it would be taken for ground."""
    rgb, sure = scene(), thing().astype(np.float32)
    sure[bar] = 1
    told = evidence(sure, rgb)
    alone = evidence(thing().astype(np.float32), rgb)
    assert alone[bar].mean() < -0.3
    assert (told[bar] >= 0).all()


def test_a_few_pixels_tell_little() -> None:
    """Of a disc of 8 px eighty are learnt, and those around it have no such colour; of one of 30 px two thousand."""
    most = []
    for radius in (8, 30):
        disc = cv2.circle(np.zeros((H, W), np.uint8), (250, 80), radius, 1, -1) > 0
        rgb = np.where(disc[..., None], (200, 30, 30), ground(2, (110, 120, 90))).astype(np.uint8)
        most.append(evidence(disc.astype(np.float32), rgb).max())
    assert most[0] < 0.3
    assert most[1] > 0.6


def test_colours_are_asked_near_borders_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of the thing in another colour, far inside of the mask, stays."""
    monkeypatch.setattr(colours, "ASKED_PX", 24.0)
    rgb, sure = scene(), thing().astype(np.float32)
    far = cv2.distanceTransform(thing().astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > 25
    rgb[far] = ground(2, (110, 120, 90))[far]
    told = evidence(sure, rgb)
    assert far.sum() > 1000
    assert not told[far].any()
    assert told.any()


def test_a_frame_twice_as_large_says_the_same() -> None:
    rgb, sure = scene(), guess()
    large = [cv2.resize(of, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST) for of in (sure, rgb)]
    small, twice = evidence(sure, rgb), evidence(*large)[::2, ::2]
    assert np.corrcoef(small.ravel(), twice.ravel())[0, 1] > 0.97


def test_a_place_has_the_colours_around_it() -> None:
    """Red before blue ground on the left, and blue before red on the right: one histogram for all tells nothing."""
    red, blue = ground(3, (180, 70, 60)), ground(4, (60, 80, 170))
    left = np.arange(W)[None, :, None] < W // 2
    things = np.zeros((H, W), bool)
    things[50:110, 40:140] = things[50:110, 370:470] = True
    rgb = np.where(things[..., None] == left, red, blue)
    sure = np.roll(things, 6, axis=1).astype(np.float32)
    told = evidence(sure, rgb)
    lost, kept = things & ~(sure > 0.5), things & (sure > 0.5)
    assert told[lost].mean() > 0.4
    assert told[(sure > 0.5) & ~things].mean() < -0.35
    assert W / 2 > 2 * CELL_PX
    assert told[kept].mean() > 0
