"""The simulator's truth against cameras, depth, the objects' own motion and a brute-force ray caster."""

import itertools

import cv2
import numpy as np
import pytest

from stages.shared import cameras, lens, lie
from stages.shared.cameras import pixel_grid
from stages.simulate import bvh, exact_motion, frames, raycast
from stages.simulate.frames import Stage, set_stage
from stages.simulate.keyframes import View, camera_path, right_of
from stages.simulate.scene import Handheld, Scene

CAMERA = {
    "focal": 1.0,
    "keys": [
        {"time": 0, "eye": [-0.3, -4.0, 1.2], "target": [0, 0, 0.8]},
        {"time": 1, "eye": [0.5, -3.6, 1.4], "target": [0.1, 0, 0.7]},
    ],
    "handheld": {"position": 0.01, "rotation_deg": 0.3},
}
GROUND = {"name": "ground", "kind": "terrain", "size": [20, 20], "relief": 0.4, "feature": 4}
MOVE, TURN_DEG = [0.6, 0.3, 0.1], [0, 0, 50]
BLOCK = {
    "name": "block",
    "kind": "box",
    "size": [0.9, 0.7, 0.8],
    "position": [-0.2, -0.4, 0.6],
    "turn_deg": [0, 0, 20],
    "path": [{"time": 0}, {"time": 1, "move": MOVE, "turn_deg": TURN_DEG}],
}
SOFT = [
    {"name": "jelly", "kind": "jelly", "radii": [0.5, 0.4, 0.4], "position": [-0.6, 0, 0.8], "hz": 3},
    {"name": "flag", "kind": "cloth", "size": [0.8, 0.8], "position": [0.5, 0, 1.6], "hz": 3},
    {"name": "hide", "kind": "breather", "size": [6, 3], "position": [0, 2, 1], "amplitude": 0.2, "hz": 2},
    {"name": "man", "kind": "walker", "height": 1.3, "position": [0.1, -0.8, 0.2]},
    {"name": "blocks", "kind": "cluster", "size": [0.5, 0.5, 0.5], "position": [1, 0.5, 0.4], "split_time": 0.1},
]


def make_stage(*objects: dict, frames: int = 4, width: int = 120, height: int = 52, **camera: object) -> Stage:
    camera = CAMERA | camera
    scene = Scene(description="", frames=frames, width=width, height=height, camera=camera, objects=objects)
    return set_stage(scene, seed=3)


def hits_and_motion(stage: Stage, frame: int = 0) -> tuple[np.ndarray, raycast.Hits, exact_motion.Motion]:
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)
    now, then = stage.moment(frame), stage.moment(frame + 1)
    hits = raycast.cast(now.snapshot, now.view, uv)
    return uv, hits, exact_motion.motion(hits, uv, stage.world, then.snapshot, then.view, now.view.K[0, 0])


def seen_body(stage: Stage, hits: raycast.Hits) -> np.ndarray:
    names = np.array([body.name for body in stage.world.bodies] + ["sky"])
    return names[np.where(hits.face >= 0, stage.world.body[hits.face], -1)]


def test_flow_of_static_pixels_is_depth_and_cameras() -> None:
    stage = make_stage(GROUND, BLOCK)
    uv, hits, moved = hits_and_motion(stage)
    now, then = stage.view(0), stage.view(1)
    points = cameras.unproject(uv, hits.depth.astype(np.float32), now.cam_from_world, now.K)
    expected = cameras.project(points, then.cam_from_world, then.K)[0] - uv
    static = ~moved.moving
    assert {"ground", "sky"} == set(seen_body(stage, hits)[static])
    assert np.abs(moved.flow - expected)[static].max() < 1e-3
    assert np.abs(moved.flow - expected)[moved.moving].max() > 1


def opencv_projection(points: np.ndarray, view: View, k1: float, k2: float) -> np.ndarray:
    rotation, _ = cv2.Rodrigues(view.cam_from_world[:3, :3])
    uv, _ = cv2.projectPoints(points, rotation, view.cam_from_world[:3, 3], view.K, np.array([k1, k2, 0, 0]))
    return uv[:, 0]


def test_flow_and_depth_of_a_lens_are_those_of_its_distorted_image() -> None:
    """OpenCV projects both ends of the flow; the depth is along the axis of the camera."""
    k1, k2 = -0.2, 0.06
    stage = make_stage(GROUND, BLOCK, distortion={"k1": k1, "k2": k2})
    uv, hits, moved = hits_and_motion(stage)
    now, then = stage.view(0), stage.view(1)
    assert np.abs(opencv_projection(hits.point, now, k1, k2) - uv).max() < 1e-6
    assert np.allclose(cameras.project(hits.point, now.cam_from_world, now.K)[1], hits.depth)
    static = ~moved.moving & ~moved.invalid
    there = opencv_projection(hits.point, then, k1, k2)
    assert np.abs(there - uv - moved.flow)[static].max() < 1e-3
    _, _, pinhole = hits_and_motion(make_stage(GROUND, BLOCK))
    assert np.abs(pinhole.flow - moved.flow)[static].max() > 0.3


def test_a_lens_of_no_distortion_changes_no_pixel() -> None:
    plain, none = make_stage(GROUND, BLOCK), make_stage(GROUND, BLOCK, distortion={"k1": 0, "k2": 0})
    images = [
        frames.develop(stage, moment := stage.moment(1), frames.see(stage, moment), True) for stage in (plain, none)
    ]
    assert np.array_equal(*images)


@pytest.mark.parametrize("coefficients", [(-0.15, 0.0), (-0.3, 0.12), (0.2, -0.05), (-0.3, 0.0)])
def test_the_inverse_of_a_distortion_is_exact(coefficients: tuple[float, float]) -> None:
    k = np.array(coefficients)
    radius = np.linspace(0, min(0.999 * lens.fold(k), 1.5), 400)
    xy = radius[:, None] * [np.cos(0.7), np.sin(0.7)]
    assert np.abs(lens.undistort(lens.distort(xy, k), k) - xy).max() < 1e-9
    beyond = lens.distort(xy[-1:], k) * 3 if np.isfinite(lens.fold(k)) else xy[-1:]
    assert np.isfinite(lens.undistort(beyond, k)).all()


def test_a_lens_that_does_not_reach_its_corners_is_refused() -> None:
    with pytest.raises(ValueError, match="corners"):
        make_stage(GROUND, distortion={"k1": -0.9, "k2": 0})


def test_flow_of_a_rigid_mover_is_its_own_motion() -> None:
    stage = make_stage(GROUND, BLOCK)
    uv, hits, moved = hits_and_motion(stage, frame=1)
    on_block = seen_body(stage, hits) == "block"
    assert on_block.sum() > 200
    assert np.array_equal(moved.moving, on_block)
    now, then = stage.view(1), stage.view(2)
    points = cameras.unproject(uv, hits.depth, now.cam_from_world, now.K)[on_block]

    def pose(time: float) -> tuple[np.ndarray, np.ndarray]:
        angle = np.deg2rad(20 + 0 * time), np.deg2rad(50 * time)
        rotations = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angle]
        return rotations[0] @ rotations[1], np.array(BLOCK["position"]) + rotations[0] @ (time * np.array(MOVE))

    (R, t), (R_next, t_next) = pose(1 / 3), pose(2 / 3)
    carried = (points - t) @ R @ R_next.T + t_next
    expected = cameras.project(carried, then.cam_from_world, then.K)[0] - uv[on_block]
    assert np.abs(moved.flow[on_block] - expected).max() < 1e-3


def test_flow_of_soft_bodies_follows_their_material() -> None:
    """Every deforming body: the surface point keeps its place in its triangle (solved here by least squares)."""
    stage = make_stage(*SOFT)
    uv, hits, moved = hits_and_motion(stage, frame=1)
    seen = seen_body(stage, hits)
    assert {shape["name"] for shape in SOFT} <= set(seen)
    now, then = stage.moment(1), stage.moment(2)
    for k in np.flatnonzero(seen != "sky")[::7]:
        corners = stage.world.faces[hits.face[k]]
        point = cameras.unproject(uv[k], hits.depth[k], now.view.cam_from_world, now.view.K)
        rows = np.vstack([now.snapshot.vertices[corners].T, np.ones(3)])
        weights = np.linalg.lstsq(rows, np.append(point, 1.0), rcond=None)[0]
        carried = weights @ then.snapshot.vertices[corners]
        expected = cameras.project(carried, then.view.cam_from_world, then.view.K)[0] - uv[k]
        assert np.abs(moved.flow[k] - expected).max() < 1e-3


def test_a_mover_is_one_in_every_frame_also_where_it_rests() -> None:
    """A block that moves between frames 2 and 3 alone, and one that never moves."""
    rests = BLOCK | {
        "path": [{"time": 0}, {"time": 2 / 5}, {"time": 3 / 5, "move": [0.6, 0, 0]}, {"time": 1, "move": [0.6, 0, 0]}]
    }
    still = {"name": "still", "kind": "box", "size": [0.9, 0.7, 0.8], "position": [1.0, 0.6, 0.6]}
    stage = make_stage(GROUND, rests, still, frames=6)
    for frame in range(5):
        _, hits, moved = hits_and_motion(stage, frame)
        on_block = seen_body(stage, hits) == "block"
        assert min(on_block.sum(), (seen_body(stage, hits) == "still").sum()) > 50
        assert np.array_equal(moved.mover, on_block)
        assert np.array_equal(moved.moving, on_block & (frame == 2))


def test_a_mover_is_its_material_not_its_body() -> None:
    """The cloth is held at its pole. How far each point gets is found here by following it through all frames."""
    stage = make_stage(*SOFT, frames=6)
    _, hits, moved = hits_and_motion(stage, frame=1)
    places = np.stack([raycast.follow(hits, stage.world, stage.moment(k).snapshot) for k in range(6)])
    farthest = np.linalg.norm(places - places[1], axis=2).max(axis=0)
    assert not moved.mover[hits.face == raycast.SKY].any()
    way_px = farthest * stage.view(1).K[0, 0] / hits.depth
    assert not (moved.moving & ~moved.mover).any()
    assert moved.mover[way_px > exact_motion.MOVED_PX].all()
    held = (way_px < exact_motion.MOVED_PX / 10) & (hits.face != raycast.SKY)
    assert held.any()
    assert not moved.mover[held].any()
    assert (moved.mover & ~moved.moving).sum() > 50


def test_the_tree_finds_what_brute_force_finds() -> None:
    stage = make_stage(GROUND | {"feature": 20}, BLOCK, *SOFT, width=48, height=20)
    now = stage.moment(2)
    uv = pixel_grid(20, 48).reshape(-1, 2)
    hits = raycast.cast(now.snapshot, now.view, uv)
    a, b, c = (now.snapshot.vertices[stage.world.faces[:, k]] for k in range(3))
    ends = cameras.unproject(uv, np.ones(len(uv)), now.view.cam_from_world, now.view.K)
    for k in range(0, len(uv), 3):
        direction = ends[k] - now.view.centre
        matrix = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=-1)
        proper = np.abs(np.linalg.det(matrix)) > 1e-14
        v, w, t = np.linalg.solve(matrix[proper], (now.view.centre - a[proper])[..., None])[..., 0].T
        inside = (v > -1e-9) & (w > -1e-9) & (v + w < 1 + 1e-9) & (t > 0)
        nearest = t[inside].min(initial=np.inf)
        assert (hits.face[k] == raycast.SKY) == np.isinf(nearest)
        assert hits.face[k] == raycast.SKY or hits.depth[k] == pytest.approx(nearest, rel=1e-9)


def test_an_empty_tree_is_never_entered() -> None:
    """A scene without movers has one; rays of every direction, from the middle of the world, must pass it by."""
    tree = bvh.build(np.zeros((0, 3, 3)), np.zeros(0, int))
    for direction in np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=3))):
        assert bvh.walk(tree, 0.0, 0.0, 0.0, *direction, 1e30, False)[1] == -1


def test_occlusion_is_visibility_in_the_next_frame() -> None:
    """Cast again at the place where the flow leads: a visible point is met there, a hidden one is behind something."""
    stage = make_stage(GROUND, BLOCK, SOFT[3])
    uv, hits, moved = hits_and_motion(stage, frame=1)
    then = stage.moment(2)
    points = raycast.follow(hits, stage.world, then.snapshot)
    again = raycast.cast(then.snapshot, then.view, uv + moved.flow)
    depth = cameras.project(points, then.view.cam_from_world, then.view.K)[1]
    hidden = again.depth < depth * (1 - exact_motion.SLACK)
    assert 0.005 < moved.occluded.mean() < 0.3
    assert np.array_equal(hidden, moved.occluded)


def test_right_eye_agrees_with_depth() -> None:
    stage = make_stage(GROUND, BLOCK)
    now = stage.moment(0)
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)
    hits = raycast.cast(now.snapshot, now.view, uv)
    right = right_of(now.view, 0.2)
    disparity = now.view.K[0, 0] * 0.2 / hits.depth
    there = raycast.cast(now.snapshot, right, uv - np.column_stack([disparity, 0 * disparity]))
    same = np.abs(there.depth - hits.depth) < 1e-6 * hits.depth
    assert same.mean() > 0.9
    assert (there.depth[~same] < hits.depth[~same]).all(), "what differs must be hidden from the right eye"


def test_points_behind_the_next_camera_are_invalid() -> None:
    stage = make_stage(GROUND)
    keys = stage.scene.camera.keys
    leap = keys[1].model_copy(update={"eye": (0.0, 6.0, 1.5), "target": (0.0, 9.0, 1.0)})
    camera = stage.scene.camera.model_copy(update={"keys": [keys[0], leap]})
    scene = stage.scene.model_copy(update={"frames": 2, "camera": camera})
    _, _, moved = hits_and_motion(set_stage(scene, seed=3))
    assert 0.1 < moved.invalid.mean() < 1
    assert np.isfinite(moved.flow).all()
    assert (moved.flow[moved.invalid] == 0).all()


def test_textures_stick_to_surfaces() -> None:
    """The next picture, sampled where the flow leads, shows the same albedo on every body, soft ones too."""
    stage = make_stage(GROUND, *SOFT, width=240, height=104)
    uv, hits, moved = hits_and_motion(stage, frame=1)
    now, then = stage.moment(1), stage.moment(2)
    again = raycast.cast(then.snapshot, then.view, uv + moved.flow)
    visible = ~moved.occluded & (again.face == hits.face)
    shown = frames.surface_at(stage, now, hits).albedo
    later = frames.surface_at(stage, then, again).albedo
    unmoved = frames.surface_at(stage, then, raycast.cast(then.snapshot, then.view, uv)).albedo
    error, naive = (np.abs(other - shown)[visible].mean() for other in (later, unmoved))
    assert visible.mean() > 0.6
    assert error < 0.01
    assert naive > 5 * error


def test_texture_has_detail_at_every_scale() -> None:
    """Contrast falls by less than a half from one octave of a picture to the next, down to single pixels."""
    wall = {"name": "wall", "kind": "box", "size": [30, 1, 20], "position": [0, 0, -9]}
    stage = make_stage(wall, width=256, height=128)
    now = stage.moment(0)
    picture = frames.develop(stage, now, frames.see(stage, now), with_effects=False).mean(axis=2)
    contrast = []
    for _ in range(4):
        halved = picture.reshape(picture.shape[0] // 2, 2, picture.shape[1] // 2, 2).mean(axis=(1, 3))
        contrast.append((picture - np.kron(halved, np.ones((2, 2)))).std() / picture.mean())
        picture = halved
    assert contrast[0] > 0.03
    assert all(fine > 0.35 * coarse for fine, coarse in itertools.pairwise(contrast))


def test_camera_meets_its_keyframes_with_a_level_horizon() -> None:
    stage = make_stage(GROUND, frames=5)
    camera = stage.scene.camera.model_copy(update={"handheld": Handheld()})
    view = camera_path(stage.scene.model_copy(update={"camera": camera}), seed=0)
    for frame, key in ((0, camera.keys[0]), (4, camera.keys[1])):
        assert np.allclose(view(frame).centre, key.eye)
        pixel, depth = cameras.project(np.array(key.target), view(frame).cam_from_world, view(frame).K)
        assert np.allclose(pixel, view(frame).K[:2, 2])
        assert depth > 0
        assert view(frame).cam_from_world[0, 2] == pytest.approx(0, abs=1e-12), "x of the camera is horizontal"
    assert view(0).K[0, 0] == pytest.approx(camera.focal * stage.scene.width)


def test_handheld_shake_has_the_stated_size() -> None:
    camera = {"keys": [CAMERA["keys"][0]], "handheld": {"position": 0.05, "rotation_deg": 1.0}}
    scene = Scene(description="", frames=1000, camera=camera, objects=[GROUND])
    views = [camera_path(scene, seed)(frame) for seed in range(4) for frame in range(0, 1000, 5)]
    offsets = np.array([view.centre for view in views]) - camera["keys"][0]["eye"]
    assert offsets.std() == pytest.approx(0.05, rel=0.15)
    still = camera_path(
        scene.model_copy(update={"camera": scene.camera.model_copy(update={"handheld": Handheld()})}), 0
    )
    turned = lie.log_so3(np.array([view.cam_from_world[:3, :3] @ still(0).cam_from_world[:3, :3].T for view in views]))
    assert np.rad2deg(turned.std()) == pytest.approx(1.0, rel=0.15)
