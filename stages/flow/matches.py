"""Large motion: dense flow initialised from sparse matches that are interpolated along image edges.

SIFT matches that fit one epipolar geometry are interpolated by RIC (Hu, Li, Song, CVPR 2017) of opencv-contrib. This
helps where dense search fails and most matches are correct. Elsewhere it costs far more time than the search and gains
nothing, so only pairs that pass a gate are treated.
"""

import threading
from collections.abc import Mapping

import cv2
import numpy as np

from stages.flow.confidence import flow_confidence
from stages.flow.dis import solve_pair
from stages.flow.edges import Edge
from stages.flow.frames import Images
from stages.shared.warp import warp

MAX_CONFIDENT_SHARE, LOST_SHARE = 0.5, 0.1
"""Pairs with a larger share of confident pixels keep their flow: first limit for fast pairs, second for all others."""
MIN_MATCHES, MIN_INLIER_SHARE, MIN_MOTION_PX = 250, 0.7, 10.0
"""The gate: least number of matches, least share of inliers to one epipolar geometry, least median motion."""
KEYPOINTS, CONTRAST, EDGE, RATIO = 4000, 0.008, 20, 0.85
"""SIFT: number of keypoints, contrast threshold, edge threshold, limit of the ratio test."""
EPIPOLAR_PX, ITERATIONS, PROBABILITY = 1.0, 2000, 0.999
"""MAGSAC: inlier threshold, iterations, confidence."""
RESIDUAL_WINDOW_PX = 9
_ONE_AT_A_TIME = threading.Lock()
"""Interpolators share state between threads: concurrent calls can return different flow."""
Features = tuple[np.ndarray, np.ndarray]
"""Keypoints [n, 2] px of a frame and their RootSIFT descriptors [n, 128]."""


def restarted_pair(
    rgb: np.ndarray | Images,
    grey: np.ndarray | Images,
    flow: Mapping[Edge, np.ndarray],
    pair: Edge,
    finest_scale: int,
) -> dict[Edge, np.ndarray]:
    """New flow [h, w, 2] px of both edges of a pair with large motion and low confidence; empty if the gate fails.

    Args:
        rgb: [T, h, w, 3] uint8. grey: [T, h, w] uint8.
        flow: [h, w, 2] px, of both edges. finest_scale: as in `solve_pair`.
    """
    i, j = pair
    if not _is_lost(flow[i, j], flow[j, i], grey[i], grey[j]):
        return {}
    inliers = trusted(sparse_matches(grey[i], grey[j]))
    if inliers is None:
        return {}
    ahead = restarted(flow[i, j], (rgb[i], rgb[j]), (grey[i], grey[j]), inliers, finest_scale)
    back = restarted(flow[j, i], (rgb[j], rgb[i]), (grey[j], grey[i]), inliers[:, ::-1], finest_scale)
    return {} if ahead is None or back is None else {(i, j): ahead, (j, i): back}


def _is_lost(flow: np.ndarray, back: np.ndarray, source: np.ndarray, target: np.ndarray) -> bool:
    """Whether hardly any pixel of a pair is confident, or few are and the median of its flow is large."""
    share = float((flow_confidence(flow, back, source, target) > 0.5).mean())
    fast = np.median(np.linalg.norm(flow, axis=-1)) > MIN_MOTION_PX / 2
    return share < (MAX_CONFIDENT_SHARE if fast else LOST_SHARE)


def sparse_matches(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Mutual SIFT matches between grey frames [h, w] uint8 that pass the ratio test: [n, 2, 2], (source, target) px."""
    return matched(features(source), features(target))


def matched(source: Features, target: Features) -> np.ndarray:
    """Mutual matches between the features of two frames that pass the ratio test: [n, 2, 2], (source, target) px."""
    (here, first), (there, second) = source, target
    if min(len(here), len(there)) < 2:
        return np.zeros((0, 2, 2), np.float32)
    similarity = first @ second.T
    best = similarity.argmax(axis=1)
    nearest = np.partition(similarity, -2, axis=1)[:, -2:]
    second_distance, distance = np.sqrt(np.maximum(2 - 2 * nearest, 0)).T
    mutual = similarity.argmax(axis=0)[best] == np.arange(len(here))
    kept = mutual & (distance < RATIO * second_distance)
    return np.stack([here[kept], there[best[kept]]], axis=1)


def trusted(matches: np.ndarray) -> np.ndarray | None:
    """The inliers [m, 2, 2] of matches [n, 2, 2] px to one epipolar geometry; None if they fail the gate."""
    if len(matches) < MIN_MATCHES:
        return None
    here, there = np.ascontiguousarray(matches[:, 0]), np.ascontiguousarray(matches[:, 1])
    cv2.setRNGSeed(0)
    _, fitting = cv2.findFundamentalMat(here, there, cv2.USAC_MAGSAC, EPIPOLAR_PX, PROBABILITY, ITERATIONS)
    if fitting is None or fitting.mean() < MIN_INLIER_SHARE:
        return None
    inliers = matches[fitting[:, 0] > 0]
    motion_px = np.linalg.norm(inliers[:, 1] - inliers[:, 0], axis=1)
    return inliers if np.median(motion_px) > MIN_MOTION_PX else None


def restarted(
    flow: np.ndarray,
    rgb: tuple[np.ndarray, np.ndarray],
    grey: tuple[np.ndarray, np.ndarray],
    matches: np.ndarray,
    finest_scale: int,
) -> np.ndarray | None:
    """Flow [h, w, 2] px: `flow`, replaced where a search from interpolated matches has a lower photometric residual.

    The result is the same bit for bit in every call and thread, provided that OpenCV itself runs single-threaded.

    Args:
        rgb, grey: source and target, [h, w, 3] and [h, w] uint8.
        matches: [n, 2, 2] (source, target) px.

    Returns:
        None if the interpolator rejects the matches (too sparse or clustered).
    """
    here, there = np.ascontiguousarray(matches[:, 0]), np.ascontiguousarray(matches[:, 1])
    try:
        with _ONE_AT_A_TIME:
            cv2.setRNGSeed(0)
            start = cv2.ximgproc.createRICInterpolator().interpolate(rgb[0], here, rgb[1], there)
    except cv2.error:
        return None
    other = solve_pair(grey[0], grey[1], start, finest_scale)
    better = photometric_residual(other, grey[0], grey[1]) < photometric_residual(flow, grey[0], grey[1])
    return np.where(better[..., None], other, flow)


def features(frame: np.ndarray) -> Features:
    """Keypoints [n, 2] px and their RootSIFT descriptors [n, 128] (Arandjelovic and Zisserman, CVPR 2012)."""
    found, descriptors = cv2.SIFT.create(KEYPOINTS, contrastThreshold=CONTRAST, edgeThreshold=EDGE).detectAndCompute(
        frame, None
    )
    if not found:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return np.array([point.pt for point in found], np.float32), np.sqrt(descriptors / total)


def photometric_residual(flow: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Photometric residual [h, w]: absolute grey-level difference after the flow, averaged over a window."""
    difference = np.abs(warp(target.astype(np.float32), flow) - source)
    return cv2.blur(difference, (RESIDUAL_WINDOW_PX, RESIDUAL_WINDOW_PX))
