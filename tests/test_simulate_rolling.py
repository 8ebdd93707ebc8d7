"""A rolling shutter: every row of the final pass is the scene at the time of that row."""

from typing import Any

import numpy as np
import pytest

from stages.simulate import frames
from stages.simulate.frames import Stage
from stages.simulate.scene import Scene

WIDTH, HEIGHT, FRAMES = 96, 48, 4
FOCAL_PX = 1.1 * WIDTH
STEP_M = 0.1
"""Motion of the camera or of the wall per frame, along the image rows."""
DISTANCE_M = 4.0
EDGE_M = -0.5
"""Left edge of the wall at frame 0; left of the axis, so that the side of the wall is not seen."""
SPEED_PX = FOCAL_PX * STEP_M / DISTANCE_M
"""The same in the image, per frame."""


def make_stage(listed: dict[str, dict[str, Any]], moves: str = "camera", colours: Any = None) -> Stage:
    """A wall across the axis; its left edge is vertical."""
    end = STEP_M * (FRAMES - 1)
    keys = [{"time": 0, "eye": [0, -DISTANCE_M, 1], "target": [0, 0, 1]}]
    if moves == "camera":
        keys.append({"time": 1, "eye": [end, -DISTANCE_M, 1], "target": [end, 0, 1]})
    path = [{"time": 0}, {"time": 1, "move": [end, 0, 0]}] if moves == "wall" else []
    texture = {"contrast": 0.8} if colours is None else {"contrast": 0, "colours": colours}
    wall = {"name": "wall", "kind": "box", "size": [40, 1, 40], "position": [20 + EDGE_M, 0.5, -20], "path": path}
    lights = {"clouds": 0, "horizon": [0, 0, 0], "zenith": [0, 0, 0]}
    scene = Scene(
        description="",
        frames=FRAMES,
        width=WIDTH,
        height=HEIGHT,
        camera={"keys": keys},
        objects=[wall | {"texture": texture}],
        lights=lights,
        effects=listed,
    )
    return frames.set_stage(scene, seed=0)


def final(stage: Stage, frame: int = 1) -> np.ndarray:
    """The final pass [H, W, 3]."""
    now = stage.moment(frame)
    seen = frames.see(stage, now)
    return frames.final(stage, frame, now, seen, frames.develop(stage, now, seen, with_effects=False))


def edge_columns(picture: np.ndarray) -> np.ndarray:
    """Column [H] at which the white wall begins in every row, from the share of the row that it covers."""
    row = picture[..., 0]
    return np.asarray(WIDTH - 0.5 - (row / row[:, -5:].mean(axis=1, keepdims=True)).sum(axis=1))


@pytest.mark.parametrize("shutter", [None, 0.5])
@pytest.mark.parametrize(("moves", "readout"), [("camera", 0.6), ("camera", -0.6), ("wall", 0.6)])
def test_a_vertical_edge_leans_by_speed_times_readout(moves: str, readout: float, shutter: float | None) -> None:
    """Also with motion blur, which widens the edge and leaves its middle where it is."""
    listed: dict[str, dict[str, Any]] = {"rolling_shutter": {"readout": readout}}
    if shutter:
        listed["motion_blur"] = {"shutter": shutter, "samples": 16}
    white = [[1, 1, 1], [1, 1, 1]]
    columns = edge_columns(final(make_stage(listed, moves, white)))
    speed = -SPEED_PX if moves == "camera" else SPEED_PX
    slope, middle = np.polyfit(np.arange(HEIGHT) - (HEIGHT - 1) / 2, columns, 1)
    assert slope == pytest.approx(readout * speed / (HEIGHT - 1), rel=0.05)
    assert middle == pytest.approx((WIDTH - 1) / 2 + FOCAL_PX * EDGE_M / DISTANCE_M + speed, abs=0.1)


@pytest.mark.parametrize("moves", ["camera", "wall"])
def test_every_row_is_that_of_a_picture_taken_at_its_time(moves: str) -> None:
    rolled = make_stage({"rolling_shutter": {"readout": 0.9}}, moves)
    picture, frozen = final(rolled), make_stage({}, moves)
    for row in (0, 10, 24, HEIGHT - 1):
        now = frozen.moment(1 + 0.9 * (row / (HEIGHT - 1) - 0.5))
        seen = frames.see(frozen, now)
        expected = frames.develop(frozen, now, seen, with_effects=False)[row]
        inner = np.abs(np.arange(WIDTH) - np.flatnonzero(expected.any(axis=1))[0]) > 2
        assert np.array_equal(picture[row][inner], expected[inner])


def test_a_readout_of_no_time_and_a_scene_at_rest_show_no_rolling_shutter() -> None:
    still = {"shadows": {"darkness": 0.9}}
    plain = final(make_stage(still))
    assert np.array_equal(final(make_stage(still | {"rolling_shutter": {"readout": 0}})), plain)
    resting = final(make_stage({"rolling_shutter": {"readout": 1}}, moves="nothing"))
    assert np.allclose(resting, final(make_stage({}, moves="nothing")), rtol=0, atol=1e-12)


def test_defocus_under_a_rolling_shutter_uses_the_depth_that_the_rows_see() -> None:
    """At the top of the image the wall's edge is elsewhere than at the time of the frame."""
    listed = {"rolling_shutter": {"readout": 1.0}, "defocus": {"focus": DISTANCE_M, "aperture_px": 4.0}}
    white = [[1, 1, 1], [1, 1, 1]]
    sharp = final(make_stage({"rolling_shutter": {"readout": 1.0}}, "wall", white))
    blurred = final(make_stage(listed, "wall", white))
    assert np.abs(blurred - sharp)[(sharp > 0.99 * sharp.max())].max() < 0.02, "the wall is in focus up to its edge"
