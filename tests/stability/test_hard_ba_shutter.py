"""Hard cases of a rolling shutter: motions that hide it, one plane, few frames, and a camera that only turns."""

import numpy as np
import pytest
from rolled import Path, hand, observe_rolled
from synthetic import PLANE, ROOM, rotation_error_deg

from stages.ba import cuts, shutter
from stages.ba.estimate import estimate
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.state import State
from stages.shared import rolling

OPTIONS = BAOptions(start_focals=(1.05,), zoom="no")
STILL = (0.0,) * 6


def solve(path: Path, readout: float = 0.8, T: int = 8, planes: tuple = ROOM) -> Estimate:
    return estimate(Problem(observe_rolled(path, readout, T, planes=planes)[0], masked=True), OPTIONS)


@pytest.mark.parametrize(
    "steady",
    [(-0.08, 0, 0, 0, 0, 0), (0, -0.08, 0, 0, 0, 0), (0, 0, -0.08, 0, 0, 0)],
    ids=["sideways", "upwards", "forwards"],
)
def test_a_camera_at_constant_velocity_does_not_show_a_rolling_shutter(steady: tuple[float, ...]) -> None:
    """Its depths make up for the time between rows: it is not found, and no cameras are bent by it."""
    solution = solve(hand(0, 0, steady))
    assert solution.rolling.decision == "not observable"
    assert np.isfinite(solution.state.cam_from_world).all()


@pytest.mark.parametrize("readout", [0.0, 0.8])
def test_a_camera_that_only_turns_shows_a_rolling_shutter(readout: float) -> None:
    path = hand(0.03, 0, STILL)
    solution = solve(path, readout)
    assert (solution.camera, solution.rolling.decision) == ("rotating", "rolling" if readout else "global")
    assert rotation_error_deg(solution.state.cam_from_world, path(np.arange(8))) < 0.03


def test_a_camera_at_rest_has_no_rolling_shutter() -> None:
    solution = solve(hand(0, 0, STILL))
    assert solution.rolling.decision in ("not observable", "global")
    assert not any("shutter" in flag for flag in solution.flags)


@pytest.mark.parametrize(("T", "planes"), [(8, PLANE), (3, ROOM)], ids=["a plane", "three frames"])
def test_little_to_see_gives_no_wrong_readout(T: int, planes: tuple) -> None:
    solution = solve(hand(0.02, 0.03), 0.6, T, planes)
    assert np.isfinite(solution.state.cam_from_world).all()
    if solution.rolling.decision == "rolling":
        assert solution.rolling.readout == pytest.approx(0.6, abs=0.2)


def test_two_frames_and_points_behind_the_camera_have_finite_corrections() -> None:
    graph, _ = observe_rolled(hand(0.02), 0.5, T=3)
    for path in (np.eye(4)[None].repeat(3, axis=0), hand(0, 0, (0, 0, 8, 0, 1, 0))(np.arange(3))):
        state = State(path, np.full((3, len(graph.pixels)), 20.0), 100.0)
        assert np.isfinite(shutter.shifts(graph, state, 1.0)).all()
    assert rolling.path_of(np.eye(4)[None].repeat(2, axis=0), np.arange(2.0))(0.5) == pytest.approx(np.zeros(6))


def test_a_shot_within_a_clip_has_the_shutter_of_its_frames() -> None:
    path, shot = hand(0.02, 0.03), np.arange(10) < 8
    graph = cuts.isolate(observe_rolled(path, 0.8)[0], shot)
    solution = cuts.estimate_shot(Problem(graph, masked=True), shot, OPTIONS)
    assert solution.rolling.decision == "rolling"
    assert solution.rolling.readout == pytest.approx(0.8, abs=0.06)
