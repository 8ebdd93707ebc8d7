"""The scene library: every scene renders, and has the difficulty that its name promises."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared import lie
from stages.shared.cameras import pixel_grid
from stages.shared.figures import spread
from stages.simulate import frames, raycast, truth
from stages.simulate.frames import Stage
from stages.simulate.scene import load_scene

REPO = Path(__file__).resolve().parents[1]
SCENES = {path.stem: path for path in sorted((REPO / "stages" / "simulate" / "scenes").glob("*.yaml"))}


def drawn_small(name: str) -> tuple[Stage, list[raycast.Hits], list[truth.Motion], np.ndarray]:
    """A library scene at 96 pixels: hits and motion at the first, middle and last pair, and the middle's picture."""
    scene = load_scene(SCENES[name])
    scene = scene.model_copy(update={"width": 96, "height": round(96 * scene.height / scene.width)})
    stage = frames.set_stage(scene, seed=0)
    uv = pixel_grid(scene.height, scene.width).reshape(-1, 2)
    hits, moved = [], []
    for frame in (0, scene.frames // 2, scene.frames - 2):
        view, then = stage.view(frame), frame + 1
        hits.append(raycast.cast(stage.world.at(frame), view, uv))
        moved.append(truth.motion(hits[-1], uv, stage.world, stage.world.at(then), stage.view(then), view.K[0, 0]))
    now = stage.moment(scene.frames // 2)
    seen = frames.see(stage, now)
    clean = frames.develop(stage, now, seen, with_effects=False)
    return stage, hits, moved, frames.final(stage, scene.frames // 2, now, seen, clean)


@pytest.fixture(scope="module")
def library() -> dict[str, tuple[Stage, list[raycast.Hits], list[truth.Motion], np.ndarray]]:
    return {name: drawn_small(name) for name in SCENES}


def test_library_is_complete(library: Any) -> None:
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


def test_scenes_have_the_difficulty_that_their_names_promise(library: Any) -> None:
    def moving(name: str) -> np.ndarray:
        return np.array([motion.moving.mean() for motion in library[name][2]])

    def centres(name: str) -> np.ndarray:
        stage = library[name][0]
        return np.array([stage.view(frame).centre for frame in range(stage.scene.frames)])

    def baseline(name: str) -> float:
        return float(np.ptp(centres(name), axis=0).max() / np.median(library[name][1][1].depth))

    assert moving("static_flight").max() == moving("rotation_static").max() == moving("planar_wall").max() == 0
    assert max(baseline("pure_rotation"), baseline("rotation_static")) < 1e-12
    assert moving("pure_rotation").max() > 0.03
    assert moving("large_object").max() > 0.4
    assert moving("all_moving").min() > 0.95
    assert 0.01 < moving("crowd_thin").mean() < 0.2
    assert 0.04 < moving("demo").mean() < 0.12
    assert baseline("demo") > 0.05
    assert baseline("breathing_wall") < 0.05
    assert np.abs(library["fast_chase"][2][1].flow).max() > 0.04 * 96, "pixels of a 96 pixel wide picture"
    assert library["long_take"][0].scene.frames == 200


def test_planar_wall_is_one_plane(library: Any) -> None:
    points = library["planar_wall"][1][1].point
    assert np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1][2] < 1e-9


def test_epipolar_mover_obeys_the_static_epipolar_geometry(library: Any) -> None:
    """Its points move in the world, yet p2^T F p1 = 0 as if they were static."""
    stage, _, moved, _ = library["epipolar_mover"]
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)[moved[0].moving]
    first, second = stage.view(0), stage.view(1)
    relative = second.cam_from_world @ lie.inverse(first.cam_from_world)
    K_inv = np.linalg.inv(first.K)
    F = K_inv.T @ lie.skew(relative[:3, 3]) @ relative[:3, :3] @ K_inv
    start = np.column_stack([uv, np.ones(len(uv))])
    end = np.column_stack([uv + moved[0].flow[moved[0].moving], np.ones(len(uv))])
    lines = start @ F.T
    distance_px = np.abs((end * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert len(uv) > 30
    assert distance_px.max() < 0.5
