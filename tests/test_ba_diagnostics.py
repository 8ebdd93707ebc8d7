"""Diagnostics of a solution: each warning is raised by what it names, and by nothing else."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import make_scene, observe

from stages.ba import diagnostics, rounds
from stages.ba.classify import Statistics
from stages.ba.initialise import Candidate, roughness
from stages.ba.state import State
from stages.shared import lie

TWISTS = np.arange(8)[:, None] * np.array([0.1, 0, 0.02, 0, 0.01, 0])
BEND = (1 - np.cos(np.arange(8)))[:, None] * np.array([0, 0.1, 0, 0, 0, 0])
MOVING = Statistics(5, 2.0, 1.0, 4.0, 0.1, 0.1, 3.0, 0.2, 6.0)
STILL = replace(MOVING, flow_px=0.1, rotation_1_px=0.05, rotation_px=0.05)
RIVAL = "rival costs the same"


def candidate(name: str, twists: np.ndarray, cost: float = 1.0, roughness: float = 0.1) -> Candidate:
    """A solution with this path, at a focal length of 400 px."""
    return Candidate(name, State(lie.exp_se3(twists), np.ones((8, 1)), 400.0), cost, roughness, [])


@pytest.mark.parametrize(
    ("roughness", "statistics", "residual_px", "rival", "said"),
    [
        (0.1, MOVING, 0.2, None, ""),
        (0.25, MOVING, 0.2, None, "rough camera path: mean |a| / mean |v| = 0.25"),
        (0.25, STILL, 0.2, None, ""),
        (0.1, MOVING, 0.35, None, "median residual 0.35 px against 0.10 px"),
        (0.1, replace(MOVING, sampson_px=0.01), 0.14, None, ""),
        (0.1, MOVING, 0.2, candidate("rival", TWISTS + BEND), RIVAL),
        (0.1, MOVING, 0.2, candidate("rival", TWISTS + BEND, cost=1.1), ""),
        (0.1, MOVING, 0.2, candidate("rival", TWISTS + BEND, roughness=0.3), ""),
        (0.1, MOVING, 0.2, candidate("rival", 3 * TWISTS * [1, 1, 1, 0, 1 / 3, 0]), ""),
    ],
)
def test_a_solution_fails_the_checks_that_its_statistics_contradict(
    roughness: float, statistics: Statistics, residual_px: float, rival: Candidate | None, said: str
) -> None:
    chosen = candidate("chosen", TWISTS, roughness=roughness)
    found = diagnostics.of_solution(chosen, [rival] if rival else [], statistics, residual_px)
    assert len(found) == bool(said)
    assert all(said in warning for warning in found)


@pytest.mark.parametrize(("growth", "warned"), [(1.0, 0), (2.5, 0), (3.5, 1)])
def test_residuals_of_rotations_that_grow_with_the_distance_of_frames_are_named(growth: float, warned: int) -> None:
    graph = observe(make_scene(motion="rotate"), offsets=(1, 5))
    far = (np.abs(graph.target - graph.source) == 5)[:, None]
    found = diagnostics.of_rotations(graph, np.where(far, growth, 1.0) * np.full(graph.weights.shape, 0.1))
    assert len(found) == warned
    assert all("the camera may translate" in warning for warning in found)


@pytest.mark.parametrize(("length", "said"), [(0.0, ""), (0.005, ""), (0.1, "error 10 % of its length"), (0.3, "")])
@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_path_is_weakly_observed_if_its_predicted_error_is_large(length: float, said: str, turn: float) -> None:
    """The error of the centres is 0.01, of rotations it is large; the camera turns on, far from the origin."""
    covariance = np.tile(np.diag([1e-4 / 3] * 3 + [1.0] * 3), (8, 1, 1))
    centres = [5.0, 0, 0] + np.linspace(0, length, 8)[:, None] * [1, 0, 0]
    rotations = lie.exp_se3(np.arange(8)[:, None] * np.array([0, 0, 0, 0, turn / 8, 0]))
    shifts = np.tile(np.eye(4), (8, 1, 1))
    shifts[:, :3, 3] = -centres
    found = diagnostics.of_path(rotations @ shifts, covariance)
    assert len(found) == bool(said)
    assert all(said in warning for warning in found)


@pytest.mark.parametrize("turning", [0.0, 1.0])
@pytest.mark.parametrize(("shake", "said"), [(1e-9, 0), (1e-5, 0), (1e-2, 1)])
def test_paths_below_the_noise_are_no_rivals(turning: float, shake: float, said: int) -> None:
    """A camera at rest, turning or not, has a path of rounding alone: any other differs from it by as much."""
    turn, rng = turning * TWISTS * [0, 0, 0, 0, 1, 0], np.random.default_rng(0)
    paths = [turn + shake * rng.standard_normal((8, 1)) * [1, 1, 1, 0, 0, 0] for _ in range(2)]
    chosen, rival = candidate("chosen", paths[0]), candidate("rival", paths[1])
    assert len(diagnostics.of_solution(chosen, [rival], STILL, 1e-6)) == said


@pytest.mark.parametrize(
    ("camera", "decision", "said"),
    [
        ("moving", "estimated", ""),
        ("moving", "weakly observed", "weakly observed: predicted error 39 %"),
        ("rotating", "weakly observed", "weakly observed: predicted error 39 %"),
        ("moving", "held at prior", "held at prior: its predicted error is 39 %"),
        ("near-still", "held at prior", "held at prior: its predicted error is 39 %"),
        ("failed", "held at prior", ""),
        ("moving", "known", ""),
    ],
)
def test_a_focal_length_that_is_not_observed_is_a_flag(camera: str, decision: str, said: str) -> None:
    focal = {"decision": decision, "relative_sigma": 0.39, "reason": "its predicted error is 39 %"}
    found = diagnostics.of_focal(camera, focal)
    assert len(found) == bool(said)
    assert all(said in flag for flag in found)


@pytest.mark.parametrize(
    ("decision", "ratio", "said"),
    [
        ("estimated", 1.02, ""),
        ("estimated", 1.17, "by +17 % since the round before, 16 times its predicted error: rounds have not converged"),
        ("weakly observed", 0.86, "by -14 %"),
        ("held at prior", 1.17, ""),
        ("known", 1.17, ""),
    ],
)
def test_rounds_that_move_the_focal_length_have_not_converged(decision: str, ratio: float, said: str) -> None:
    now = {"decision": decision, "relative_sigma": 0.01, "focal_px": 400 * ratio}
    found = diagnostics.of_rounds(now, {"decision": "held at prior", "relative_sigma": 0.2, "focal_px": 400})
    assert len(found) == bool(said)
    assert all(said in flag for flag in found)


@pytest.mark.parametrize(
    ("share", "ignored", "before", "said"),
    [
        (0.6, 0, None, ""),
        (0.6, 0, 0.8, ""),
        (0.5, 0, 0.8, "static area shrank from 0.80 to 0.50"),
        (0.9, 0, 0.5, ""),
        (0.9, 2, None, "masks of 2 of 4 frames ignored"),
    ],
)
def test_masks_raise_a_warning_when_they_grow_or_leave_nothing(
    share: float, ignored: int, before: float | None, said: str
) -> None:
    static = np.zeros((4, 10, 10))
    static.reshape(4, -1)[:, : round(100 * share)] = 1
    found = diagnostics.of_masks(static, np.arange(4) < ignored, before)
    assert len(found) == bool(said)
    assert all(said in flag for flag in found)


def test_the_distance_of_paths_is_that_of_their_centres_after_alignment() -> None:
    offset = np.zeros((8, 3))
    offset[::2, 1] = 0.01
    poses = lie.exp_se3(TWISTS)
    moved = poses.copy()
    moved[:, :3, 3] -= (poses[:, :3, :3] @ offset[..., None])[..., 0]
    moved = moved @ lie.exp_se3(np.array([1.0, 2, 3, 0.4, 0, 0.2]))
    moved[:, :3, 3] *= 7
    apart, length = diagnostics.path_difference(poses, moved)
    steps = np.diff(lie.inverse(poses)[:, :3, 3], axis=0)
    assert length == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    assert apart == pytest.approx(0.005, rel=0.05)


@pytest.mark.parametrize(("share", "same"), [(0.004, True), (0.006, False)])
def test_static_areas_are_the_same_within_half_a_per_cent(share: float, same: bool) -> None:
    before = np.ones((10, 10, 100), np.float32)
    now = before.copy()
    now[:, 0, : round(1000 * share)] = 0
    assert rounds.is_same(now, before) == same
    one = np.ones((300, 10, 10), np.float32)
    one[100] = 0
    assert not rounds.is_same(one, np.ones_like(one)), "a frame that is now dynamic"


@pytest.mark.parametrize(
    ("about", "converged"),
    [
        ({"from_previous_round": True, "flags": ["rough camera path"]}, True),
        ({"from_previous_round": False, "flags": []}, False),
        ({"from_previous_round": True, "flags": ["focal length moved: rounds have not converged"]}, False),
    ],
)
def test_only_a_continued_round_without_the_warning_has_converged(
    about: dict[str, Any], converged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rounds, "read_metadata", lambda _: about)
    assert rounds.has_converged(rounds.complete(*[Path("x")] * 4)) == converged


def test_dropped_frames_do_not_make_a_path_rough() -> None:
    """A camera on an arc at constant speed, seen at the times that a phone has kept."""
    kept = np.delete(np.arange(40), [9, 10, 22, 31, 33])
    poses = np.tile(np.eye(4), (len(kept), 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(kept / 60), np.cos(kept / 60), np.zeros(len(kept))], axis=-1)
    assert roughness(poses) > 0.2
    assert roughness(poses, kept / 30) < 0.05
    assert roughness(poses, np.arange(len(kept)) / 30) == pytest.approx(roughness(poses))
