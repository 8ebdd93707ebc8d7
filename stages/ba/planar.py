"""Camera paths from the homographies of one dominant plane, where epipolar geometry is degenerate."""

import cv2
import numpy as np

from stages.ba import twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.shared import lie

THRESHOLD_PX = 0.5
"""Inlier threshold of a match on the plane."""


def homography(graph: FlowGraph, i: int, j: int) -> np.ndarray | None:
    """RANSAC homography [3, 3] from frame i to j, in px from the principal point; None with too few matches."""
    x, y, _ = twoview.pair_rays(graph, i, j, 1.0)
    if len(x) < MIN_MATCHES:
        return None
    H, _ = cv2.findHomography(x, y, cv2.RANSAC, THRESHOLD_PX)
    return None if H is None else np.asarray(H)


def homographies(graph: FlowGraph) -> list[np.ndarray | None]:
    """Homographies of the T - 1 pairs of neighbouring frames."""
    return [homography(graph, i, i + 1) for i in range(graph.T - 1)]


def chain_planes(steps: list[np.ndarray | None], focal_px: float | np.ndarray) -> np.ndarray:
    """Camera poses [T, 4, 4] from the homographies of one plane, whose distance to the first camera is 1.

    A homography has two solutions for motion and normal (Faugeras and Lustman, 1988). The plane is fixed in the world,
    so the normal of one pair predicts that of the next: of the two possible first normals, the one with the smallest
    prediction error is kept. A pair without homography repeats the motion of the pair before.

    Args:
        steps: the T - 1 homographies of neighbouring frames; focal_px: focal length of all frames, or [T] of each.
    """
    focals_px = np.broadcast_to(focal_px, len(steps) + 1)
    pairs = zip(steps, focals_px[:-1], focals_px[1:], strict=True)
    motions = [_motions(H, float(here), float(there)) if H is not None else [] for H, here, there in pairs]
    first = next((options for options in motions if options), [])
    if not first:
        return np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    paths = [_follow(motions, normal) for _, _, normal in first]
    return min(paths, key=lambda path: path[1])[0]


def _follow(
    motions: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]], normal: np.ndarray
) -> tuple[np.ndarray, float]:
    """Poses [T, 4, 4] from the motions with normals nearest to the predicted ones; sum of squared prediction errors."""
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


def _motions(H: np.ndarray, focal_px: float, other_px: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rotation, translation over distance, and normal (into the scene) of each decomposition of H."""
    K = np.diag([focal_px, focal_px, 1.0])
    same_lens = np.diag([focal_px / other_px, focal_px / other_px, 1.0]) @ H
    _, rotations, translations, normals = cv2.decomposeHomographyMat(same_lens, K)
    found = zip(rotations, translations, normals, strict=True)
    return [(R, t.ravel(), n.ravel()) for R, t, n in found if n[2, 0] > 0]
