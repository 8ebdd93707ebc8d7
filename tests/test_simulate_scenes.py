"""The scene library: every scene renders, and has the difficulty that its name promises."""

from pathlib import Path

import numpy as np
import pytest

from stages.configuration.config import Config
from stages.configuration.datasets import scene_files
from stages.shared import lie
from stages.shared.cameras import pixel_grid
from stages.shared.drawing import spread
from stages.simulate import exact_motion, frames, raycast
from stages.simulate.frames import Stage
from stages.simulate.keyframes import camera_path
from stages.simulate.scene import load_scene

REPO = Path(__file__).resolve().parents[1]
SCENES = {path.stem: path for path in sorted((REPO / "stages" / "simulate" / "scenes").glob("*.yaml"))}
Drawn = tuple[Stage, list[raycast.Hits], list[exact_motion.Motion], np.ndarray]
Library = dict[str, Drawn]


def drawn_small(name: str) -> Drawn:
    """A library scene at 96 pixels: hits and motion at the first, middle and last pair, and the middle's picture."""
    scene = load_scene(SCENES[name])
    scene = scene.model_copy(update={"width": 96, "height": round(96 * scene.height / scene.width)})
    stage = frames.set_stage(scene, seed=0)
    uv = pixel_grid(scene.height, scene.width).reshape(-1, 2)
    hits, moved = [], []
    for frame in (0, scene.frames // 2, scene.frames - 2):
        view, then = stage.view(frame), frame + 1
        hits.append(raycast.cast(stage.world.at(frame), view, uv))
        moved.append(
            exact_motion.motion(hits[-1], uv, stage.world, stage.world.at(then), stage.view(then), view.K[0, 0])
        )
    now = stage.moment(scene.frames // 2)
    seen = frames.see(stage, now)
    clean = frames.develop(stage, now, seen, with_effects=False)
    return stage, hits, moved, frames.final(stage, scene.frames // 2, now, seen, clean)


@pytest.fixture(scope="module")
def library() -> Library:
    return {name: drawn_small(name) for name in SCENES}


def test_library_is_complete(library: Library) -> None:
    assert len(library) >= 16
    for name, (stage, hits, moved, picture) in library.items():
        assert "\n" not in stage.scene.description, name
        assert np.isfinite(picture).all(), name
        assert 0.02 < np.median(picture) < 0.7, name
        assert np.std(np.log(np.maximum(picture, 1e-3))) > 0.1, name
        for k in range(3):
            assert (hits[k].depth > 0).all(), name
            assert np.isfinite(moved[k].flow).all(), name
        for frame in spread(stage.scene.frames, 5):
            assert raycast.enclosing(stage.world, stage.world.at(frame), stage.view(frame).centre) is None, name


def test_every_scene_says_whether_it_was_tuned_on() -> None:
    """A figure of a scene on which thresholds were chosen says nothing about footage that nobody has seen."""
    scenes = {name: load_scene(path) for name, path in SCENES.items()}
    assert {scene.split for scene in scenes.values()} == {"tuned", "test"}
    assert sum(scene.split == "test" for scene in scenes.values()) >= 10
    assert len({scene.description for scene in scenes.values()}) == len(scenes)


def moving(drawn: Drawn) -> np.ndarray:
    """Share of moving pixels at the first, middle and last pair [3]."""
    return np.array([motion.moving.mean() for motion in drawn[2]])


def baseline(drawn: Drawn) -> float:
    """How far the camera travels, in units of the median depth."""
    stage = drawn[0]
    centres = np.array([stage.view(frame).centre for frame in range(stage.scene.frames)])
    return float(np.ptp(centres, axis=0).max() / np.median(drawn[1][1].depth))


def test_scenes_have_the_difficulty_that_their_names_promise(library: Library) -> None:
    assert (
        moving(library["static_flight"]).max()
        == moving(library["rotation_static"]).max()
        == moving(library["planar_wall"]).max()
        == 0
    )
    assert max(baseline(library["pure_rotation"]), baseline(library["rotation_static"])) < 1e-12
    assert moving(library["pure_rotation"]).max() > 0.03
    assert moving(library["large_object"]).max() > 0.4
    assert moving(library["all_moving"]).min() > 0.95
    assert 0.01 < moving(library["crowd_thin"]).mean() < 0.2
    assert 0.04 < moving(library["demo"]).mean() < 0.12
    assert baseline(library["demo"]) > 0.05
    assert baseline(library["breathing_wall"]) < 0.05
    assert np.abs(library["fast_chase"][2][1].flow).max() > 0.04 * 96, "pixels of a 96 pixel wide picture"
    assert library["long_take"][0].scene.frames == 200


def test_test_scenes_have_the_difficulty_that_their_names_promise(library: Library) -> None:
    assert moving(library["ruin_walk"]).max() == 0
    assert baseline(library["pan_canal"]) < 1e-12
    assert baseline(library["resting_fair"]) < 1e-3
    assert 0.35 < moving(library["festival_crowd"]).min() < moving(library["festival_crowd"]).max() < 0.5
    assert moving(library["toy_train"])[1] < 0.3 * moving(library["toy_train"])[[0, 2]].min(), (
        "it waits in the middle of the clip"
    )
    assert np.abs(library["blurred_karts"][2][1].flow).max() > 0.04 * 96, "pixels of a 96 pixel wide picture"
    zoomed = library["zoom_station"][0]
    assert zoomed.view(zoomed.scene.frames - 1).K[0, 0] > 1.5 * zoomed.view(0).K[0, 0]


def test_planar_wall_is_one_plane(library: Library) -> None:
    points = library["planar_wall"][1][1].point
    assert np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1][2] < 1e-9


@pytest.mark.parametrize(("name", "mover"), [("epipolar_mover", "crate on rails"), ("oncoming_tram", "tram")])
def test_movers_along_the_line_of_travel_obey_the_static_epipolar_geometry(
    library: Library, name: str, mover: str
) -> None:
    """Their points move in the world, yet p2^T F p1 = 0 as if they were static."""
    stage, hits, moved, _ = library[name]
    bodies = np.array([body.name == mover for body in stage.world.bodies])
    seen = (hits[0].face >= 0) & bodies[stage.world.body[hits[0].face]]
    assert moved[0].moving[seen].all()
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)[seen]
    first, second = stage.view(0), stage.view(1)
    relative = second.cam_from_world @ lie.inverse(first.cam_from_world)
    K_inv = np.linalg.inv(first.K)
    F = K_inv.T @ lie.skew(relative[:3, 3]) @ relative[:3, :3] @ K_inv
    start = np.column_stack([uv, np.ones(len(uv))])
    end = np.column_stack([uv + moved[0].flow[seen], np.ones(len(uv))])
    lines = start @ F.T
    distance_px = np.abs((end * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert len(uv) > 30
    assert distance_px.max() < 0.5


def test_the_long_walk_returns_and_runs_by_name_alone() -> None:
    assert "long_walk" not in scene_files(Config(scenes="all"))
    assert "long_walk" not in scene_files(Config(scenes="tuned"))
    scene = load_scene(scene_files(Config(scenes=["long_walk"]))["long_walk"])
    assert scene.split == "tuned"
    assert scene.frames == 1000
    path = camera_path(scene, seed=0)
    centres = np.array([path(frame).centre for frame in range(0, 1000, 5)])
    walked = np.append(0, np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    again = (np.abs(walked[:, None] - walked) > 30) & (apart < 1.5)
    assert again.any(axis=1)[-60:].all(), "the second lap lies beside the first"


def test_something_moves_in_the_first_frames_of_the_long_walk() -> None:
    """The benchmark of long video compares its first 50 frames with more: a stage must have the same to do in them."""
    scene = load_scene(REPO / "stages/simulate/scenes/long/long_walk.yaml").model_copy(
        update={"width": 96, "height": 54}
    )
    stage = frames.set_stage(scene, seed=0)
    uv = pixel_grid(scene.height, scene.width).reshape(-1, 2)
    for frame in (0, 25, 49):
        now, then = stage.moment(frame), stage.moment(frame + 1)
        hits = raycast.cast(now.snapshot, now.view, uv)
        moved = exact_motion.motion(hits, uv, stage.world, then.snapshot, then.view, now.view.K[0, 0])
        assert moved.moving.mean() > 0.005
