"""Whether given cameras explain the flow, or another reading does: direction and axes of poses, focal length."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from stages.ba import classify, twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.ba.rotation import FOCALS
from stages.shared import lie
from stages.shared.conventions import FLIP
from stages.shared.errors import InputError

GIVEN = "as given"
READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    GIVEN: lambda poses: poses,
    "in the opposite direction (camera-to-world for world-to-camera or the reverse)": lie.inverse,
    "with OpenGL axes (x right, y up, z backward)": lambda poses: FLIP @ poses,
    "in the opposite direction and with OpenGL axes": lambda poses: FLIP @ lie.inverse(poses),
}
"""How cam_from_world [T, 4, 4] follows from the poses as they were read, if the file means something else."""
PAIRS = 8
STATIC = 20
"""Percentile of a pair's residuals that stands for its static pixels: all above it may be movers and outliers. (On 20
scenes it is at most 0.2 px under the true poses, even where a mover fills most of the view, and 0.3 to 72 px under
other readings.)
"""
FLOOR_PX = 0.2
"""Residuals below this are no misfit."""
CLEARLY = 3.0
"""Another reading is clearly better if its residual is this many times smaller."""
NOTHING_EXPLAINED = 0.5
"""Poses that leave this share of the flow are those of other frames."""
FITS_PX = 0.5
"""Another reading is named only if its residual is below this."""
POOR = 4.0
"""From this many times the residual of the epipolar geometry fitted to each pair on, there is a warning."""
FOCAL_TOLERANCE = 0.003
"""Tolerance of the logarithm of the focal length that suits poses best."""
FACTORS = (0.53, 0.73, 1.0, 1.37, 1.88)
"""Factors on a given focal length that are compared: 1.88 is 1920 px over 1024 px, numbers of a video before it is
reduced."""
POOR_FOCAL = 1.8
"""A given focal length is doubted if its residual is so many times that of another. (At 0.93 to 1.07 of the true one it
is at most 1.3 times as large on 9 scenes; twice or half of it shows on scenes with enough parallax.)
"""
OFF_CENTRE = 0.25
"""A principal point so far from the middle, in widths or heights of the frame, is doubted."""
AHEAD = 0.1
"""A point nearer to the second camera than this share of its depth in the first counts as behind it."""


def check(graph: FlowGraph, source: str, cam_from_world: np.ndarray, focals_px: np.ndarray, seed: int) -> list[str]:
    """Warnings about given poses [T, 4, 4] of a file `source` that fit the matches poorly, at focal lengths [T] px.

    Raises:
        InputError: if another reading of the file fits clearly better, or none explains the flow.
    """
    found = residuals_px(graph, cam_from_world, focals_px)
    given, best = found[GIVEN], min(found, key=lambda name: found[name])
    if not np.isfinite(given) or given < FLOOR_PX:
        return []
    if given > CLEARLY * found[best] and found[best] < FITS_PX:
        expected = f"poses that explain the flow, which these do {best}"
        told = f"{given:.2g} px of residual as given, {found[best]:.2g} px so"
        raise InputError(source, expected, told, "convert the file, or name it in its own format: docs/conventions.md")
    still = np.tile(np.eye(4), (graph.T, 1, 1))
    flow_px = _residual_px(graph, still, focals_px)
    if given > NOTHING_EXPLAINED * flow_px:
        told = f"{given:.2g} px of residual at {flow_px:.2g} px of flow, and {found[best]:.2g} px by any other reading"
        advice = "check that poses and intrinsics are those of these frames, and the order of their numbers"
        raise InputError(source, "poses that explain the flow", told, advice)
    noise_px = classify.measure(graph, float(np.median(focals_px)), seed).sampson_px
    if given > POOR * noise_px:
        return [f"given poses fit poorly: their residual is {given:.2g} px, that of pairs of frames {noise_px:.2g} px"]
    return []


def best_focal(graph: FlowGraph, cam_from_world: np.ndarray) -> float:
    """The focal length, px, out of `FOCALS` at which some reading of the poses leaves the smallest residual."""

    def left(focal_px: float) -> float:
        return min(residuals_px(graph, cam_from_world, np.full(graph.T, focal_px)).values())

    focals_px = FOCALS * graph.long_side_px
    best = int(np.argmin([left(focal_px) for focal_px in focals_px.tolist()]))
    if not np.isfinite(left(float(focals_px[best]))):
        return float(focals_px[best])
    bounds = np.log([focals_px[max(best - 1, 0)], focals_px[min(best + 1, len(focals_px) - 1)]])
    options = {"xatol": FOCAL_TOLERANCE}
    found = minimize_scalar(lambda log: left(float(np.exp(log))), bounds=bounds, method="bounded", options=options)
    return float(np.exp(found.x))


def doubts_about_lens(graph: FlowGraph, focal_px: float, seed: int) -> list[str]:
    """Warnings about a focal length, px, and a principal point, that of the graph, which the user states.

    Numbers of frames at another size are the usual mistake. A focal length is compared with others by epipolar
    geometry, or by a rotation if the camera only turns; where they fit alike nothing can be told.
    """
    size = np.array([graph.width, graph.height])
    middle, centre = (size - 1) / 2, graph.centre * [1, graph.aspect]
    off = float((np.abs(centre - middle) / size).max())
    advice = "are the numbers those of another size?"
    found = (
        [f"the given principal point is {off:.0%} of the frame from its middle; {advice}"] if off > OFF_CENTRE else []
    )
    of_factor = {factor: classify.measure(graph, factor * focal_px, seed) for factor in FACTORS}
    turns = any(of.camera == "rotating" for of in of_factor.values())
    left_px = {factor: of.rotation_px if turns else of.sampson_px for factor, of in of_factor.items()}
    best = min(left_px, key=lambda factor: left_px[factor])
    if left_px[1.0] > POOR_FOCAL * left_px[best]:
        told = f"{left_px[1.0]:.2g} px of residual between frames, {left_px[best]:.2g} px at {best:g} times of it"
        found.append(f"the given focal length fits poorly: {told}; {advice}")
    return found


def residuals_px(graph: FlowGraph, cam_from_world: np.ndarray, focals_px: np.ndarray) -> dict[str, float]:
    """Residual, px, of static matches under every reading of the poses [T, 4, 4]; infinite without enough matches.

    The depth of a match is free, but in front of the cameras: otherwise a path and its reverse would fit alike where
    the camera does not turn. `focals_px` is [T].
    """
    return {name: _residual_px(graph, read(cam_from_world), focals_px) for name, read in READINGS.items()}


def _residual_px(graph: FlowGraph, cam_from_world: np.ndarray, focals_px: np.ndarray) -> float:
    """Median over at most PAIRS pairs of frames of their residual in px at the percentile STATIC."""
    step = max(int(length) for length in np.unique(graph.target - graph.source) if length <= classify.BASELINE)
    pairs, found = [(i, i + step) for i in range(graph.T - step)], []
    for k in np.unique(np.linspace(0, len(pairs) - 1, PAIRS).astype(int)):
        i, j = pairs[k]
        x, y, _ = twoview.pair_rays(graph, i, j, focals_px[i], focals_px[j])
        if len(x) >= MIN_MATCHES:
            motion = cam_from_world[j] @ lie.inverse(cam_from_world[i])
            found.append(np.percentile(_misfit(motion, x, y), STATIC) * focals_px[j])
    return float(np.median(found)) if found else float("inf")


def _misfit(motion: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance [n] of rays y [n, 2] from where a motion [4, 4] takes rays x [n, 2] at their best depth in front."""
    R, t = motion[:3, :3], motion[:3, 3]
    length = np.linalg.norm(t)
    t = t / length if length > 0 else t
    inverse_depth = np.maximum(twoview.triangulate(R, t, x, y)[0], 0)
    points = np.column_stack([x, np.ones(len(x))]) @ R.T + inverse_depth[:, None] * t
    ahead = np.maximum(points[:, 2:], AHEAD)
    return np.linalg.norm(points[:, :2] / ahead - y, axis=1)
