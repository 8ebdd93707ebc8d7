"""Colours of static points: which are seen, and over what part of their surface they are averaged."""

from dataclasses import replace

import numpy as np
import pytest
from lit_room import lit_room

from stages.scene import sightings
from stages.scene.observed import Observed
from stages.scene.sightings import sight
from stages.scene.windows import FOOTPRINT_PX2, SMOOTH_PX, WIDEST, Windows, windows


@pytest.mark.parametrize("count", [215, 350, 1000])
def test_every_frame_of_a_long_clip_is_seen_by_static_points(count: int) -> None:
    h, w = 24, 36
    shade = np.random.default_rng(0).uniform(0.3, 0.6, (h, w, 3)).astype(np.float32)
    poses = np.tile(np.eye(4), (count, 1, 1))
    K = np.array([[30.0, 0, w / 2], [0, 30.0, h / 2], [0, 0, 1]])
    none, one = np.zeros((count, h, w), bool), np.ones((h, w))
    rgb, depth = (np.broadcast_to(x, (count, *x.shape)) for x in (shade, one))
    links = np.zeros((0, 2), int), np.zeros((0, h, w, 2)), np.zeros((0, h, w)), np.zeros(0, int)
    points = sight(Observed(rgb, none, none, depth, poses, np.broadcast_to(K, (count, 3, 3)), *links))
    assert 300 < len(points.points) <= 700
    assert points.usable.any(axis=2).sum(axis=0).min() > 100


def test_what_is_burnt_in_is_no_point_of_the_scene() -> None:
    room, scene = lit_room(), np.ones((96, 160), bool)
    scene[10:50, 100:150] = False
    logo = np.array([0.1, 0.9, 0.1])
    shown = replace(room, rgb=np.where(scene[..., None], room.rgb, logo).astype(np.float32))
    for known, found in ((None, True), (scene, False)):
        seen = sight(replace(shown, scene=known))
        green = seen.colours[..., 1] - seen.colours[..., 0] > 0.4
        assert (green & seen.usable.all(axis=2)).any() == found


def test_smoothing_mixes_nothing_hidden_in() -> None:
    """It is wider where points are nearer: what is burnt in, white here, must not brighten the points beside it."""
    wall, scene = lit_room(wall=True), np.ones((96, 160), bool)
    scene[10:80, 60:110] = False
    shown = replace(wall, rgb=np.where(scene[..., None], wall.rgb, np.float32(1)), scene=scene)
    brightest = [found.colours[found.usable].max() for found in map(sight, (wall, shown))]
    assert brightest[1] < brightest[0] + 0.02


def test_windows_cover_the_same_of_a_surface_in_all_frames() -> None:
    """In no frame less than SMOOTH_PX of the image, and where one of them is wide it is not the others as well."""
    turns = np.linspace(0.2, 1.0, 4)
    J = np.stack([np.array([[1.3 * np.cos(a), 0.2], [0.1, 1.0 + 0.2 * a]]) for a in turns])  # px per place
    square = np.array([[0, 0], [5, 0], [0, 5], [5, 5]], float)
    corners = np.einsum("fij,cj->cfi", J, square)[None]
    shown = np.ones((1, 5), bool)
    shown[0, 4] = False
    found = windows(np.concatenate([corners, np.full((1, 4, 1, 2), 7.0)], axis=2), shown)
    along, across = found.along[0, :4], found.variance[0, :4]
    image = across[:, None, None] * np.eye(2) + along[:, :, None] * along[:, None] + FOOTPRINT_PX2 * np.eye(2)
    surface = np.linalg.inv(J) @ image @ np.swapaxes(np.linalg.inv(J), 1, 2)
    assert surface == pytest.approx(np.broadcast_to(surface[0], surface.shape), rel=1e-6, abs=1e-6)
    assert across.min() == pytest.approx(SMOOTH_PX**2, rel=1e-6)
    assert found.reach.max() < WIDEST * SMOOTH_PX
    assert np.isfinite(found.reach).all()


def test_a_square_that_is_seen_edge_on_has_the_longest_windows() -> None:
    corners = np.array([[0.0, 0], [5, 0], [0, 5], [5, 5]])[None, :, None] * np.array([[1, 1], [1, 1e-4]])[:, None, None]
    found = windows(np.swapaxes(corners, 0, 1).reshape(1, 4, 2, 2), np.ones((1, 2), bool))
    assert found.reach.max() == pytest.approx(WIDEST * SMOOTH_PX)
    assert found.variance.min() >= SMOOTH_PX**2 - 1e-9


@pytest.mark.parametrize("shape", [np.zeros((2, 2)), np.array([[1.0, 0], [0, 0]])], ids=["point", "line"])
def test_a_square_that_collapses_in_a_frame_leaves_the_windows_of_the_others(shape: np.ndarray) -> None:
    square = np.array([[0.0, 0], [5, 0], [0, 5], [5, 5]])
    corners = np.stack([square, square * (0.8, 0.6), square @ shape.T], axis=1)[None]
    collapsed = windows(corners, np.ones((1, 3), bool))
    without = windows(corners[:, :, :2], np.ones((1, 2), bool))
    assert collapsed.variance[:, :2] == pytest.approx(without.variance)
    assert np.abs(collapsed.along[:, :2]) == pytest.approx(np.abs(without.along))
    assert np.isfinite(collapsed.reach).all()


def test_a_window_that_reaches_beyond_the_picture_is_not_seen() -> None:
    """There it would repeat the border."""
    uv = np.array([[[10.0, 10.0], [3.0, 10.0], [10.0, 0.0], [36.0, 10.0]]])
    along = np.broadcast_to([2.0, 0.0], uv.shape)
    found = sightings._is_within(uv, Windows(np.ones((1, 4)), along), (20, 40))
    assert found.tolist() == [[True, False, True, False]]
