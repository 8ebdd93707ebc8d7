"""Motion evidence from flow alone: the residual of each pixel's flow to the two-view geometry of its frame pair."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numba
import numpy as np

from stages.shared.flow_pairs import REACH, FlowPairs
from stages.shared.sampson import sampson_distances
from stages.shared.threads import threaded

MIN_CONFIDENCE = 0.5
MIN_MATCHES = 50
MAX_ITERATIONS = 500
"""Enough to draw seven inliers once with probability 99.99 % where 60 % of the matches are inliers."""
RANSAC_MATCHES = 1500
"""MAGSAC++ gains nothing from more."""
FLAT_SHARE = 0.75
FLAT_PX = 1.0
"""If a homography fits this share of the confident matches to 1 px, the fundamental matrix is undetermined."""
SIGMA_RANGE_PX = (1.0, 3.0)
"""Robust scale: three times the median residual, within these bounds."""

Fit = Callable[[np.ndarray, np.ndarray, cv2.UsacParams], np.ndarray | None]
Errors = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Evidence(NamedTuple):
    """Robust residual (Geman-McClure, 0..1) of the flow to rigid motion [T, h, w]; its weight, summed over edges."""

    residual: np.ndarray
    weight: np.ndarray


def flat_share(pairs: FlowPairs, seed: int) -> float:
    """Share of the confident matches that a homography fits to 1 px, at the frame distance where it is least.

    Near 1 there is no parallax: the camera only turns, hardly moves, or looks at a plane. Then the epipole is
    undetermined and a fit would place it to explain moving objects. 1 without matches.
    """
    forward = [(i, j) for i, j in pairs.edges if 0 < j - i <= REACH]

    def share(pair: tuple[int, int]) -> float | None:
        x, y = _confident(pairs, pair)
        H = fit_homography(x, y, _usac(FLAT_PX, seed)) if len(x) >= MIN_MATCHES else None
        return None if H is None else float((homography_errors(H, x, y) < FLAT_PX).mean())

    shares: dict[int, list[float]] = {}
    for (i, j), found in zip(forward, pairs.threaded(share, forward), strict=True):
        if found is not None:
            shares.setdefault(j - i, []).append(found)
    return min((float(np.median(of_distance)) for of_distance in shares.values()), default=1.0)


def two_view_evidence(pairs: FlowPairs, T: int, parallax: bool, seed: int) -> Evidence:
    """Geman-McClure cost of the epipolar (or, without parallax, homography) residual, averaged over a frame's edges.

    Every edge has its reverse.
    """
    fit, errors = (fit_fundamental, epipolar_errors) if parallax else (fit_homography, homography_errors)
    params = _usac(ransac_threshold_px(pairs), seed)
    forward = [(i, j) for i, j in pairs.edges if 0 < j - i <= REACH]

    def fitted(pair: tuple[int, int]) -> tuple[np.ndarray, float] | None:
        x, y = _confident(pairs, pair)
        model = fit(x, y, params) if len(x) >= MIN_MATCHES else None
        return None if model is None else (model, float(np.clip(3 * np.median(errors(model, x, y)), *SIGMA_RANGE_PX)))

    fits = dict(zip(forward, pairs.threaded(fitted, forward), strict=True))

    def of_frame(frame: int) -> tuple[np.ndarray, np.ndarray]:
        residual, weight = (np.zeros(pairs.pixels.shape[:2], np.float32) for _ in range(2))
        for e in pairs.leaving(frame, frame + 1):
            i, j = frame, int(pairs.target[e])
            found = fits.get((min(i, j), max(i, j)))
            if found is not None:
                model, sigma_px = found
                its_model = model if i < j else model.T if parallax else np.linalg.inv(model)
                squared = (errors(its_model, pairs.pixels, pairs.matches(e)) / np.float32(sigma_px)) ** 2
                of_edge = pairs.weights(e)
                residual += of_edge * squared / (1 + squared)
                weight += of_edge
        return residual / np.maximum(weight, 1e-6), weight

    residual, weight = (np.empty((T, *pairs.pixels.shape[:2]), np.float32) for _ in range(2))
    for first, last in pairs.blocks(T, "two-view evidence"):
        for k, found in enumerate(threaded(of_frame, range(first, last)), first):
            residual[k], weight[k] = found
    return Evidence(residual, weight)


def ransac_threshold_px(pairs: FlowPairs) -> float:
    """Inlier threshold: 7.5 % of the median motion of the shortest edges within 0.2..0.5 px.

    A wider one counts moving objects as inliers and biases the geometry.
    """
    shortest = min((abs(i - j) for i, j in pairs.edges), default=0)
    moves = [
        np.median(np.linalg.norm((pairs.matches(e) - pairs.pixels)[::2, ::2], axis=-1))
        for (i, j), e in pairs.edges.items()
        if abs(i - j) == shortest
    ]
    return float(np.clip(0.075 * np.median(moves), 0.2, 0.5)) if moves else 0.2


def fit_fundamental(x: np.ndarray, y: np.ndarray, params: cv2.UsacParams) -> np.ndarray | None:
    """F [3, 3] with y^T F x = 0 of matches [n, 2] px by MAGSAC++ (Barath et al., CVPR 2020); None if there is none."""
    step = max(1, len(x) // RANSAC_MATCHES)
    try:
        F, _ = cv2.findFundamentalMat(x[::step], y[::step], params)
    except cv2.error:  # its local optimisation raises an assertion when matches leave F undetermined
        return None
    return F if F is not None and F.shape == (3, 3) else None


def fit_homography(x: np.ndarray, y: np.ndarray, params: cv2.UsacParams) -> np.ndarray | None:
    """H [3, 3] with y ~ H x of matches [n, 2] px by MAGSAC++; None if there is none."""
    step = max(1, len(x) // RANSAC_MATCHES)
    H, _ = cv2.findHomography(x[::step], y[::step], params)
    return H if H is not None and np.linalg.matrix_rank(H) == 3 else None


def epipolar_errors(F: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sampson distance [...] px, without sign, of matches x, y [..., 2] from the epipolar geometry F."""
    return np.abs(sampson_distances(F, x, y))


def homography_errors(H: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Transfer error |y - H x| [...] px of matches x, y [..., 2]."""
    flat = _transfer(H, np.reshape(x, (-1, 2)), np.reshape(y, (-1, 2)))
    return np.asarray(flat.reshape(x.shape[:-1]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _transfer(H, x, y):  # type: ignore[no-untyped-def]
    errors = np.empty(len(x), np.float32)
    for k in range(len(x)):
        u, v = x[k, 0], x[k, 1]
        z = H[2, 0] * u + H[2, 1] * v + H[2, 2]
        du = y[k, 0] - (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / z
        dv = y[k, 1] - (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / z
        errors[k] = np.sqrt(du * du + dv * dv)
    return errors


def _confident(pairs: FlowPairs, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Confident matches x [n, 2] and y [n, 2] of every other row and column of an edge and its reverse, pooled."""
    edge, back = pairs.edges[pair], pairs.edges[pair[::-1]]
    x, y = _collect(pairs.pixels, pairs.matches(edge), pairs.weights(edge))
    y_back, x_back = _collect(pairs.pixels, pairs.matches(back), pairs.weights(back))
    return np.concatenate([x, x_back]), np.concatenate([y, y_back])


@numba.njit(cache=True, nogil=True)
def _collect(pixels, matches, weights):  # type: ignore[no-untyped-def]
    h, w = weights.shape
    x, y = np.empty((h * w, 2), np.float32), np.empty((h * w, 2), np.float32)
    n = 0
    for row in range(0, h, 2):
        for column in range(0, w, 2):
            if weights[row, column] > MIN_CONFIDENCE:
                for c in range(2):  # assigning whole rows would also compile numba's error messages for shapes
                    x[n, c], y[n, c] = pixels[row, column, c], matches[row, column, c]
                n += 1
    return x[:n], y[:n]


def _usac(threshold_px: float, seed: int) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 3, 50
    params.confidence, params.threshold, params.maxIterations = 0.9999, threshold_px, MAX_ITERATIONS
    params.randomGeneratorState = seed
    return params
