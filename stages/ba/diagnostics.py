"""Diagnostics of a solution, as warnings in words: from its statistics, focal length, masks and the previous round."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stages.ba import shutter, zoom
from stages.ba.classify import FLOOR_PX, RESIDUAL_RATIO, Statistics, longest_step
from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.initialise import Candidate
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate
from stages.ba.rounds import NOT_CONVERGED, SHRANK
from stages.shared import lie

ROUGH_PATH = 0.2
SAME_COST, SAME_PATH, SAME_ROUGHNESS = 0.05, 0.05, 2.0
"""An alternative solution is serious if its relative extra cost and its roughness ratio are below the first and last
limit, and its path differs by more than the second (share of the path length)."""
SHRINKING = 0.7
"""A static area below this share of that of the previous round suggests that masks grow without bound."""
KEPT = 0.2
"""Below this share of the lower border the masks are doubted (`stages.ba.ground.share_kept`)."""
WEAK_PATH = 0.05
"""Predicted error of the camera centres, as a share of the path, from which on the path is weakly observed. It is
0.028 and less in all scenes that limits are chosen on but dark_fog, whose path is wrong: there it is 0.097."""
MOVED = 3.0
"""Converged rounds change the focal length by less than this many predicted errors (measured: by at most 0.4)."""


def of_solution(
    chosen: Candidate, others: Sequence[Candidate], statistics: Statistics, residual_px: float
) -> list[str]:
    """The checks that a solution fails, in words; empty if it passes all."""
    found = []
    if statistics.camera == "moving" and chosen.roughness > ROUGH_PATH:
        found.append(f"rough camera path: mean |a| / mean |v| = {chosen.roughness:.2f} > {ROUGH_PATH}")
    if residual_px > RESIDUAL_RATIO * max(statistics.sampson_px, FLOOR_PX):
        found.append(f"median residual {residual_px:.2f} px against {statistics.sampson_px:.2f} px of two-view fits")
    for other in others:
        apart, length = path_difference(chosen.state.cam_from_world, other.state.cam_from_world)
        # Paths are the same if their difference moves a pixel of median depth, 1, by less than the noise of the flow.
        seen = apart * chosen.state.focal_px > max(residual_px, FLOOR_PX)
        as_smooth = other.roughness <= SAME_ROUGHNESS * chosen.roughness
        if seen and other.cost <= chosen.cost * (1 + SAME_COST) and as_smooth and apart > SAME_PATH * length:
            share = 100 * apart / length
            found.append(f"{other.name} costs the same and differs by {share:.0f} % of the path")
    return found


def of_rotations(graph: FlowGraph, errors_px: np.ndarray) -> list[str]:
    """A warning if the residuals [E, P] of rotations grow with the frame distance, as those of a translating camera.

    The noise of the flow hardly grows (measured on turning cameras: from 0.04 px between neighbours to 0.08 px).
    """
    distance, step = np.abs(graph.target - graph.source), longest_step(graph)
    confident = graph.weights > MIN_WEIGHT
    near, far = (float(np.median(errors_px[(distance == k)[:, None] & confident])) for k in (distance.min(), step))
    if far <= RESIDUAL_RATIO * max(near, FLOOR_PX):
        return []
    return [
        f"residual of rotations {near:.2f} px between neighbours, {far:.2f} px over {step} frames: "
        "the camera may translate"
    ]


def of_ground(statistics: Statistics) -> list[str]:
    """A warning where a path explains the flow, too, were it not that the ground before the camera rests."""
    if not statistics.by_ground:
        return []
    rests = f"as {100 * (statistics.ground or 0.0):.0f} % of the lower border rests"
    return [
        f"the camera is taken for one that does not move, {rests}: if no ground is near there, it may move, and what "
        "seems to be movers may be all that is near"
    ]


def of_near(kept: float | None, known_focal: bool) -> list[str]:
    """A warning where masks leave hardly any of the lower border, a share `kept`, where the ground is near."""
    if kept is None or kept >= KEPT:
        return []
    advice = "look at the masks" if known_focal else "look at the masks, or give the focal length (`intrinsics`)"
    seems = "all that is near seems to move, as before wrong cameras and focal lengths"
    return [f"masks leave {100 * kept:.0f} % of the lower border: {seems}: {advice}"]


def of_focal(camera: str, focal: Mapping[str, Any]) -> list[str]:
    """A warning about the focal length decision, as stored in the artifact, for a camera of this class."""
    if focal["decision"] == "weakly observed":
        return [f"focal length weakly observed: predicted error {100 * focal['relative_sigma']:.0f} %"]
    if focal["decision"] == "held at prior" and camera in ("moving", "near-still"):
        return [f"focal length held at prior: {focal['reason']}"]
    return []


def of_path(cam_from_world: np.ndarray, covariance: np.ndarray) -> list[str]:
    """A warning if the path [T, 4, 4] is short against its predicted error, as where a camera hardly moves.

    There is none if it is shorter than the error: then nothing of it is known. The path of a camera at rest is that of
    its noise, frame by frame, which is longer: of such a camera it is said, too.

    Args:
        covariance: [T, 6, 6] of the left twists, translation first: of the camera centres too, but for a rotation.
    """
    centres = lie.inverse(cam_from_world)[:, :3, 3]
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
    sigma = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean())
    if not WEAK_PATH * length < sigma < length:
        return []
    return [f"camera path weakly observed: predicted error {100 * sigma / length:.0f} % of its length"]


def of_zoom(evidence: zoom.Evidence) -> list[str]:
    """A warning about a focal length that changes: it explains the flow, but not observably so, or it is asked for and
    explains nothing.
    """
    explains = evidence.gain is None or zoom.explains(evidence.gain, evidence.gain_sigma or 0.0)
    if evidence.decision == "changing" and not explains:
        return [f"a focal length per frame, {evidence.reason}"]
    if evidence.decision != "not observable" or not explains:
        return []
    return [f"the focal length may change over the frames, which is not observable: {evidence.reason}"]


def of_shutter(evidence: shutter.Evidence) -> list[str]:
    """A warning about a rolling shutter, also where it explains the flow, but not observably so.

    A readout that is not known to itself, as before a camera that hardly moves, only fits the errors of the flow.
    """
    gain, gain_sigma = evidence.gain or 0.0, evidence.gain_sigma or 0.0
    if evidence.decision == "rolling":
        taken = "poses are those of the middle row; a frame is drawn as exposed at once"
        return [f"rolling shutter: {evidence.reason}; {taken}"]
    explains = gain >= max(shutter.MIN_GAIN, shutter.SIGNIFICANT * gain_sigma)
    known = evidence.readout_sigma is not None and abs(evidence.readout) >= evidence.readout_sigma
    if evidence.decision == "not observable" and explains and known:
        return [f"the shutter may roll, which is not observable: {evidence.reason}"]
    return []


def of_options(solution: Estimate, options: BAOptions) -> list[str]:
    """Warnings about effects that the options ask for, and that a camera which does not move leaves no room for."""
    found = []
    still = {"near-still": "the camera hardly moves", "rotating": "the camera only turns, at one focal length"}
    if options.zoom == "yes" and solution.zoom.decision == "not tested" and solution.camera in still:
        found.append(f"`zoom: yes` is not followed: {still[solution.camera]}")
    if options.rolling_shutter == "yes" and solution.camera == "near-still" and solution.rolling.decision != "rolling":
        found.append("`rolling_shutter: yes` is not followed: the camera hardly moves, its rows differ by noise alone")
    return found


def of_rounds(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """A warning if the focal length changed between rounds; both decisions as stored in the artifact."""
    if now["decision"] not in ("estimated", "weakly observed"):
        return []
    moved = np.log(now["focal_px"] / before["focal_px"])
    sigmas = abs(moved) / max(now["relative_sigma"], 1e-12)
    if sigmas <= MOVED:
        return []
    words = f"focal length moved by {100 * np.expm1(moved):+.0f} % since the round before"
    return [f"{words}, {sigmas:.0f} times its predicted error: {NOT_CONVERGED}"]


def of_masks(static: np.ndarray, ignored: np.ndarray, share_before: float | None) -> list[str]:
    """Warnings about masks that leave the static area `static` [T, h, w] and were ignored in some frames [T].

    Args:
        share_before: static share of the image in the round before, if there was one.
    """
    found = []
    if ignored.any():
        found.append(f"masks of {ignored.sum()} of {len(ignored)} frames ignored: they leave too little static area")
    if share_before and static.mean() < SHRINKING * share_before:
        shares = f"from {share_before:.2f} to {static.mean():.2f}"
        readings = "either new movers were found or the masks grow without bound: compare the masks of both rounds"
        found.append(f"{SHRANK} {shares} since the round before: {readings}")
    return found


def path_difference(cam_from_world: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """RMS distance of the camera centres after similarity alignment, and the length of the first path.

    Unlike `stages.shared.alignment.umeyama` it accepts straight paths: the rotation about the line changes no distance.
    """
    a, b = (lie.inverse(poses)[:, :3, 3] for poses in (cam_from_world, other))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, singular, Vt = np.linalg.svd(a.T @ b)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = (singular * signs).sum() / max((b**2).sum(), 1e-300)
    aligned = scale * b @ (U * signs @ Vt).T
    length = np.linalg.norm(np.diff(a, axis=0), axis=1).sum()
    return float(np.sqrt(((a - aligned) ** 2).sum(axis=1).mean())), float(length)
