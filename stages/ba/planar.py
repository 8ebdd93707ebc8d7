"""Camera paths from the homographies of one dominant plane, which two-view motion by epipolar geometry leaves open."""

import cv2
import numpy as np

from stages.ba import twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.shared import lie

THRESHOLD_PX = 0.5
"""Distance up to which a match belongs to the plane."""


def homography(graph: FlowGraph, i: int, j: int) -> np.ndarray | None:
    """Homography [3, 3] from frame i to j of most matches, in px from the principal point; None without enough."""
    x, y, _ = twoview.pair_rays(graph, i, j, 1.0)
    if len(x) < MIN_MATCHES:
        return None
    H, _ = cv2.findHomography(x, y, cv2.RANSAC, THRESHOLD_PX)
    return None if H is None else np.asarray(H)


def homographies(graph: FlowGraph) -> list[np.ndarray | None]:
    """Homographies of the T - 1 pairs of neighbouring frames."""
    return [homography(graph, i, i + 1) for i in range(graph.T - 1)]


def chain_planes(steps: list[np.ndarray | None], focal_px: float) -> np.ndarray:
    """Camera poses [T, 4, 4] that see one plane through these homographies, its first distance 1.

    A homography leaves two motions and two normals (Faugeras and Lustman, 1988). The plane stays where it is in the
    world, so the normal that one pair leaves predicts that of the next: of the two possible first normals the one
    whose predictions are met best is kept. A pair without homography repeats the motion before it.
    """
    motions = [_motions(H, focal_px) if H is not None else [] for H in steps]
    first = next((options for options in motions if options), [])
    if not first:
        return np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    paths = [_follow(motions, normal) for _, _, normal in first]
    return min(paths, key=lambda path: path[1])[0]


def _follow(
    motions: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]], normal: np.ndarray
) -> tuple[np.ndarray, float]:
    """Poses [T, 4, 4] from the motions whose normals are nearest to the predicted ones; sum of squared misses."""
    cam_from_world = np.tile(np.eye(4), (len(motions) + 1, 1, 1))
    motion, distance, missed = np.eye(4), 1.0, 0.0
    for k, options in enumerate(motions):
        if options:
            R, t, found = min(options, key=lambda option: float(((option[2] - normal) ** 2).sum()))
            missed += float(((found - normal) ** 2).sum())
            motion, normal = lie.from_parts(R, distance * t), R @ found
            distance = max(distance * (1 + float(normal @ t)), 1e-3)
        cam_from_world[k + 1] = motion @ cam_from_world[k]
    return cam_from_world, missed


def _motions(H: np.ndarray, focal_px: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rotation, translation over distance, and normal (both into the scene) of the motions that H stands for."""
    K = np.diag([focal_px, focal_px, 1.0])
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, K)
    found = zip(rotations, translations, normals, strict=True)
    return [(R, t.ravel(), n.ravel()) for R, t, n in found if n[2, 0] > 0]
