"""Where Gaussians start: dense depth, labels, skinning and its inverse, the cap, masks that nothing can carry."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import CANONICAL, TRAIN, image_at, new_scene, psnr
from numpy.testing import assert_allclose

from stages.gaussians.initial_cloud import cloud_within, initial_cloud
from stages.gaussians.lifting import lift, near_plane_of
from stages.gaussians.skinning import skin, to_canonical
from stages.gaussians.training_frames import with_movers
from stages.gaussians.votes import DEPTH_TOLERANCE, dynamic_share, pixels_of, static_share
from stages.shared.dense_depth import dense_depth, nearest_on_frame
from stages.splatting.gaussian_model import GaussianScene


def test_static_gaussians_never_move_and_labels_are_right() -> None:
    seen = truth.observations(TRAIN)
    scene = new_scene(seen)
    n = scene.n_static
    assert 0 < n < len(scene.means)
    for time in (0.0, 0.3, 1.0):
        means, quats, _ = scene.at(time)
        assert torch.equal(means[:n], scene.means[:n])
        assert torch.equal(quats[:n], scene.gaussians["quats"][:n])
        offset = means[n:] - torch.tensor(truth.square_centre(time), dtype=torch.float32)
        assert (offset.abs() < truth.HALF + 0.05).all()  # every dynamic Gaussian stays on the square
    assert (scene.means[:n, 2] - truth.WALL_Z).abs().max() < 1e-4  # every static one on the wall


def test_one_false_mask_is_outvoted() -> None:
    """A patch of wall masked in one frame only stays static; the vote counts only frames that see the point."""
    seen = truth.observations(TRAIN)
    seen.masks[0, 50:58, 4:14] = True
    v, u = 54, 8
    keep = np.zeros(seen.masks[0].shape, bool)
    keep[50:58, 4:14] = True
    points = lift(seen, 0, keep, stride_px=2)
    assert len(points.positions) > 10
    assert seen.masks[0, v, u]
    assert (dynamic_share(seen, lambda _: points.positions, seen.masks) < 0.5).all()
    scene = new_scene(seen)
    dynamic = scene.means[scene.n_static :].detach().numpy()
    assert (np.abs(dynamic[:, 2] - truth.SQUARE_Z) < 0.05).all()


def test_a_mover_whose_motion_is_off_leaves_nothing_hanging_in_the_air() -> None:
    """Control points that stand still carry the square out of most masks: its pixels must not stay behind as static."""
    seen = truth.observations(TRAIN)
    motion = truth.true_motion()
    with torch.no_grad():
        motion.table.zero_()
    cloud = initial_cloud(seen, motion, CANONICAL, stride_px=2, K=4, sh_degree=0)
    on_square = (cloud.means[:, 2] - truth.SQUARE_Z).abs() < 0.05
    assert on_square.sum() > 100
    assert cloud.dynamic[on_square].all()


def test_a_mover_before_a_camera_that_only_turns_is_not_left_behind_where_it_was() -> None:
    """Depth tells no surface apart there, and control points follow the square up to the middle of the clip alone."""
    seen = truth.observations(TRAIN)
    seen = replace(seen, depths=np.full_like(seen.depths, truth.SQUARE_Z))
    motion = truth.true_motion()
    with torch.no_grad():
        motion.table[len(TRAIN) // 2 :] = motion.table[len(TRAIN) // 2]
    cloud = initial_cloud(seen, motion, CANONICAL, stride_px=2, K=4, sh_degree=0, movers_every=3)
    first = torch.isclose(cloud.births, torch.tensor(seen.times[0], dtype=torch.float32))
    u, v, _, inside = pixels_of(seen, 0, cloud.means[first & ~cloud.dynamic].double().numpy())
    assert (first & cloud.dynamic).sum() > 50
    assert not seen.masks[0][v[inside], u[inside]].any()


def test_the_wall_behind_the_mover_is_not_claimed_by_it() -> None:
    seen = truth.observations(TRAIN)
    behind = truth.square_centre(0.5) * (truth.WALL_Z / truth.SQUARE_Z)
    assert dynamic_share(seen, lambda _: behind[None], seen.masks)[0] == 0
    on_square = np.stack([truth.square_centre(time) for time in seen.times])[:, None]
    assert dynamic_share(seen, lambda f: on_square[f], seen.masks)[0] == 1


@pytest.mark.parametrize("burnt_in", [False, True])
def test_votes_are_those_of_the_pixels_that_points_project_to(burnt_in: bool) -> None:
    """Points before, on and behind the surfaces, beside the image and behind the camera, against numpy."""
    seen, F = truth.observations(TRAIN), len(TRAIN)
    if burnt_in:
        seen = replace(seen, scene=np.arange(seen.masks[0].size).reshape(seen.size) % 5 > 0)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (9000, 3)) * truth.WALL_Z
    points[::2, 2] = truth.WALL_Z * np.linspace(0.9, 1.1, 4500)
    points[::3] = points[::3, 2:] * [0.1, 0.1, 1] + points[::3] * [0.1, 0.1, 0]  # the middle of the image
    views, masked, resting = np.zeros((3, len(points)))
    for f in range(F):
        u, v, z, inside = pixels_of(seen, f, points)
        depth, mask = seen.depths[f][v, u], seen.masks[f][v, u]
        visible = inside & (z < depth * (1 + DEPTH_TOLERANCE))
        views += visible
        masked += visible & mask
        resting += visible & ~mask & (depth < z * (1 + DEPTH_TOLERANCE))
    assert min(masked.sum(), resting.sum(), (views == 0).sum()) > 50
    assert_allclose(dynamic_share(seen, lambda _: points, seen.masks), masked / np.maximum(views, 1))
    assert_allclose(static_share(seen, points, seen.masks), resting / np.maximum(views, 1))


def test_skinning_and_its_inverse() -> None:
    motion = truth.true_motion()
    with torch.no_grad():
        motion.table[..., :4] += 0.05 * torch.randn(motion.table[..., :4].shape, generator=torch.manual_seed(0))
    rest = motion.points + 0.05
    with torch.no_grad():
        moved = skin(rest, 0.9, motion, 4).double().numpy()
    canonical, found = to_canonical(moved, np.full(len(moved), 0.9), motion, 4)
    assert found.all()
    assert np.abs(canonical - rest.numpy()).max() < 1e-3


def test_a_wholly_masked_image_keeps_what_no_control_point_reaches() -> None:
    seen = truth.observations(TRAIN)
    seen.masks[:] = True
    kept = with_movers(seen, truth.true_motion())
    square = truth.observations(TRAIN).masks
    masks = np.array([kept.masks[f] for f in range(len(TRAIN))])
    assert masks[square].all()
    assert not masks[:, :, :8].any()
    motion = truth.true_motion()
    cloud = initial_cloud(kept, motion, CANONICAL, stride_px=2, K=4, sh_degree=0)
    scene = GaussianScene(cloud, motion, torch.zeros(3), near_plane_of(kept), neighbours=4)
    expected, _, mask = truth.ray_cast(truth.cameras()[0], truth.TIMES[0])
    assert psnr(image_at(scene, 0), expected, np.ones_like(mask)) > 20


def test_depth_of_a_slanted_plane_is_exact_and_edges_follow_the_image() -> None:
    s, (height, width) = 4, (64, 96)
    u = np.arange(width)
    inverse = np.broadcast_to(0.2 + 0.002 * u, (height, width))
    coarse = np.broadcast_to(0.2 + 0.002 * (s * np.arange(width // s) + (s - 1) / 2), (height // s, width // s))
    flat = np.full((height, width, 3), 0.5, np.float32)
    inner = np.s_[12:-12, 12:-12]
    assert np.abs(1 / dense_depth(coarse, flat, s) - inverse)[inner].max() < 1e-4
    step = np.where(u < 50, 1.0, 0.25)  # the edge lies inside a grid cell
    image = np.repeat(np.broadcast_to(np.where(u < 50, 0.9, 0.1), (height, width))[..., None], 3, axis=2)
    coarse_step = np.broadcast_to(step[s // 2 :: s], (height // s, width // s))
    sharp = 1 / dense_depth(coarse_step, image.astype(np.float32), s)
    bilinear = np.interp(u, s * np.arange(width // s) + (s - 1) / 2, step[s // 2 :: s])
    assert np.abs(sharp - step)[inner].mean() < 0.6 * np.abs(bilinear - step)[12:-12].mean()


def test_dense_depth_is_the_mean_of_four_grid_pixels_weighted_by_place_and_colour() -> None:
    rng, s = np.random.default_rng(0), 4
    coarse, image = rng.uniform(0.2, 1, (6, 8)), rng.uniform(0.4, 0.6, (6 * s, 8 * s, 3)).astype(np.float32)
    y, x = 9, 14  # at 1.875 and 3.125 of the grid
    place = np.outer([0.125, 0.875], [0.875, 0.125])
    unlike = np.square(image[[6, 10]][:, [14, 18]].astype(float) - image[y, x]).sum(axis=-1)
    weights = place * (np.exp(-unlike / (2 * 0.06**2)) + 1e-4)
    expected = (weights * coarse[1:3, 3:5]).sum() / weights.sum()
    assert 1 / dense_depth(coarse, image, s)[y, x] == pytest.approx(expected, rel=1e-5)


def test_a_grid_whose_stride_is_no_whole_number_does_not_drift() -> None:
    s, (height, width), (h, w) = 854 / 128, (480, 854), (72, 128)  # flow 512 px wide, every fourth pixel of it
    coarse = np.broadcast_to(0.2 + 0.002 * (s * np.arange(w) + (s - 1) / 2), (h, w))
    inverse = 1 / dense_depth(coarse, np.full((height, width, 3), 0.5, np.float32), s)
    assert np.abs(inverse - (0.2 + 0.002 * np.arange(width)))[12:-12, 12:-12].max() < 1e-4
    column = nearest_on_frame(np.broadcast_to(np.arange(w), (1, h, w)), s, height, width)[0, 0]
    assert np.abs(column - (np.arange(width) + 0.5) / s + 0.5).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_depth_of_any_unit_and_of_the_sky(unit: float) -> None:
    coarse = np.random.default_rng(0).uniform(0.2, 1, (16, 24)) / unit
    coarse[:4] = 0  # infinitely far
    depth = dense_depth(coarse, np.full((64, 96, 3), 0.5, np.float32), 4)
    assert np.isfinite(depth).all()
    assert depth.min() > 0.9 * unit
    assert depth.max() < 2e4 * unit


def test_guessed_depth_of_movers_comes_from_the_control_points() -> None:
    seen = truth.observations(TRAIN)
    seen.depths[seen.masks] = 4.0  # what a fill from the background would give
    seen.guessed[:] = True
    repaired = with_movers(seen, truth.true_motion())
    expected = truth.observations(TRAIN).depths
    depths = np.array([repaired.depths[f] for f in range(len(TRAIN))])
    assert np.abs(depths / expected - 1)[seen.masks].max() < 0.01
    assert np.array_equal(depths[~seen.masks], seen.depths[~seen.masks])


def test_the_cap_raises_the_stride() -> None:
    seen = truth.observations(TRAIN)
    cloud, stride_px = cloud_within(seen, truth.true_motion(), CANONICAL, 1, 4, 0, max_gaussians=1000)
    assert len(cloud.means) <= 1000
    assert stride_px > 1
    whole = initial_cloud(seen, truth.true_motion(), CANONICAL, stride_px, K=4, sh_degree=0)
    assert torch.equal(cloud.means, whole.means)  # what is given up early is given up anyway
    finer = initial_cloud(seen, truth.true_motion(), CANONICAL, stride_px - 1, K=4, sh_degree=0)
    assert len(finer.means) > 1000
