"""Relative motion of two frames from flow matches: essential matrix, its refinement, triangulation, pure rotation.

Matches are rays with z = 1: x [n, 2] in the first camera, y [n, 2] in the second. The model is y ~ R x + d t with
inverse depth d of the first camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from stages.ba.graph import MIN_MATCHES, MIN_WEIGHT, FlowGraph
from stages.shared import lie
from stages.shared.sampson import sampson_distances, sampson_terms

RANSAC_MATCHES = 1500
"""Number of matches for RANSAC, which gains nothing from more; the refinement uses all matches."""
REFINEMENTS = 12
"""Gauss-Newton steps of a two-view motion."""
MAX_LOG_RATIO_STEP = 0.1
"""Largest step of the logarithm of the ratio of two focal lengths."""
ROTATION_SIGMA_PX = 0.5
"""The last robust scale of a rotation."""
GENERATORS = np.stack([lie.skew(axis) for axis in np.eye(3)])
"""Skew matrices [3, 3, 3] of the three axes."""


@dataclass(frozen=True)
class TwoView:
    """Motion of a pair of frames: y ~ R x + d t with |t| = 1."""

    R: np.ndarray
    t: np.ndarray


def pair_rays(
    graph: FlowGraph, i: int, j: int, focal_px: float, other_px: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays x [n, 2] in frame i, y [n, 2] in frame j and weights [n] of the confident matches of both edges.

    Args:
        focal_px: focal length of frame i; other_px: of frame j, if it differs.
    """
    x, y, w = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0)]
    for edge, forward in ((graph.edge(i, j), True), (graph.edge(j, i), False)):
        if edge is not None:
            confident = graph.weights[edge] > MIN_WEIGHT
            here, there = graph.pixels[confident], graph.matches[edge][confident].astype(float)
            x.append(here if forward else there)
            y.append(there if forward else here)
            w.append(graph.weights[edge][confident].astype(float))
    centre = graph.centre
    rays = (np.concatenate(x) - centre) / focal_px, (np.concatenate(y) - centre) / (other_px or focal_px)
    return *rays, np.concatenate(w)


def estimate_motion(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, focal_px: float, threshold_px: float, seed: int
) -> TwoView | None:
    """Robust relative motion: RANSAC on a subset, then Geman-McClure refinement of the Sampson error on all matches.

    Models are scored by MSAC: MAGSAC++ marginalises over thresholds far above `threshold_px`, and then the motion of a
    fifth of the pixels can win (tests/test_ba_start.py has the case).

    Returns:
        None when there are too few matches or no model.
    """
    if len(x) < MIN_MATCHES:
        return None
    step = max(1, len(x) // RANSAC_MATCHES)
    params = cv2.UsacParams()
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    params.confidence, params.threshold, params.maxIterations = 0.9999, threshold_px / focal_px, 2000
    params.randomGeneratorState = seed
    identity, none = np.eye(3), np.zeros(0)
    E, inliers = cv2.findEssentialMat(x[::step], y[::step], identity, identity, none, none, params)
    if E is None or E.shape != (3, 3) or not inliers.any():
        return None
    chosen = inliers.ravel() > 0
    R, t = _decompose(E, x[::step][chosen], y[::step][chosen])
    return _refine_motion(R, t, x, y, w, threshold_px / focal_px)


def _refine_motion(R: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, sigma: float) -> TwoView:
    """Minimise the weighted Sampson error over (R, direction of t); the robust scale falls from 3 sigma to sigma."""
    for scale in np.geomspace(3 * sigma, sigma, REFINEMENTS):
        across = _tangent_basis(t)
        normal, gradient = _sampson_system(R, t, across, x, y, w, scale)
        step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), -gradient)
        R, t = lie.exp_so3(step[:3]) @ R, t + step[3:] @ across
        t = t / np.linalg.norm(t)
    d, parallax = triangulate(R, t, x, y)
    fits = np.abs(sampson_errors(R, t, x, y)) < 2 * sigma
    if (d[fits] * parallax[fits]).sum() < 0:
        t = -t
    return TwoView(R, t)


def zoom_ratio(
    motion: TwoView, x: np.ndarray, y: np.ndarray, w: np.ndarray, threshold_px: float, focal_px: float
) -> float:
    """Focal length of the second frame over that of the first, which gave both rays.

    The motion is refined with this ratio s as a sixth unknown: y is s times the ray, so E becomes diag(1/s, 1/s, 1) E.
    """
    R, t, log_ratio, sigma = motion.R, motion.t, 0.0, threshold_px / focal_px
    for scale in np.geomspace(3 * sigma, sigma, REFINEMENTS):
        lens, across = np.diag([np.exp(-log_ratio), np.exp(-log_ratio), 1.0]), _tangent_basis(t)
        E = lens @ lie.skew(t) @ R
        by_motion = lens @ np.concatenate([lie.skew(t) @ GENERATORS, lie.skew(across)]) @ R
        directions = np.concatenate([by_motion, (E * [[-1.0], [-1.0], [0.0]])[None]])
        normal, gradient = _sum_normal(E, directions.reshape(6, 9), x, y, w, scale)
        step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), -gradient)
        R, t = lie.exp_so3(step[:3]) @ R, t + step[3:5] @ across
        t = t / np.linalg.norm(t)
        log_ratio += float(np.clip(step[5], -MAX_LOG_RATIO_STEP, MAX_LOG_RATIO_STEP))
    return float(np.exp(log_ratio))


def sampson_errors(R: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Signed Sampson distances [n] of the matches from the epipolar geometry of (R, t), in units of the rays."""
    return sampson_distances(lie.skew(t) @ R, x, y)


def triangulate(R: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares inverse depths [n] in the first camera, and parallax [n]: shift of y per unit of inverse depth."""
    turned = _homogeneous(x) @ R.T
    slope = t[:2] - y * t[2]
    offset = y * turned[:, 2:] - turned[:, :2]
    squared = (slope**2).sum(axis=1)
    return (slope * offset).sum(axis=1) / np.maximum(squared, 1e-12), np.sqrt(squared)


def fit_rotation(x: np.ndarray, y: np.ndarray, w: np.ndarray, focal_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Robust rotation R [3, 3] with y ~ R x, and the residuals [n] in px.

    It starts from the median flow: from zero rotation, a fast pan that follows a mover would converge to the mover.
    """
    R = np.eye(3)
    if len(x):
        across, down = np.median(y - x, axis=0)
        R = lie.exp_so3(np.array([-np.arctan(down), np.arctan(across), 0.0]))
    for level_px in np.maximum(20 * 0.5 ** np.arange(10), ROTATION_SIGMA_PX):
        normal, rhs = _rotation_system(R, x, y, w, focal_px, level_px)
        R = lie.exp_so3(np.linalg.solve(normal + 1e-9 * (np.trace(normal) + 1) * np.eye(3), rhs)) @ R
    return R, np.linalg.norm(_rotation_residual(R, x, y, focal_px)[0], axis=1)


def fit_turn_and_zoom(x: np.ndarray, y: np.ndarray, w: np.ndarray, focal_px: float) -> tuple[np.ndarray, float]:
    """Robust rotation R [3, 3] and ratio s of the focal lengths, second over first, with y ~ diag(s, s, 1) R x.

    Both rays by the focal length of the first frame. It starts from the rotation alone.
    """
    R, log_ratio = fit_rotation(x, y, w, focal_px)[0], 0.0
    for level_px in np.maximum(20 * 0.5 ** np.arange(10), ROTATION_SIGMA_PX):
        r, u = _rotation_residual(R, x, y * np.exp(-log_ratio), focal_px)
        robust = w / (1 + (r**2).sum(axis=1) / level_px**2) ** 2
        a, b = u[:, 0], u[:, 1]
        J = focal_px * np.stack([[-a * b, 1 + a * a, -b, a], [-1 - b * b, a * b, a, b]]).transpose(2, 0, 1)
        normal = np.einsum("nci,n,ncj->ij", J, robust, J)
        rhs = np.einsum("nci,n,nc->i", J, robust, r)
        step = np.linalg.solve(normal + 1e-9 * (np.trace(normal) + 1) * np.eye(4), rhs)
        R, log_ratio = (
            lie.exp_so3(step[:3]) @ R,
            log_ratio + float(np.clip(step[3], -MAX_LOG_RATIO_STEP, MAX_LOG_RATIO_STEP)),
        )
    return R, float(np.exp(log_ratio))


def _rotation_residual(R: np.ndarray, x: np.ndarray, y: np.ndarray, focal_px: float) -> tuple[np.ndarray, np.ndarray]:
    turned = _homogeneous(x) @ R.T
    u = turned[:, :2] / turned[:, 2:]
    return (y - u) * focal_px, u


@njit(cache=True, error_model="numpy")
def _rotation_system(
    R: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, focal_px: float, level_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Robust normal matrix [3, 3] and right-hand side [3] of a left rotation vector, at a scale of `level_px`."""
    normal, rhs, J = np.zeros((3, 3)), np.zeros(3), np.empty((2, 3))
    for m in range(len(x)):
        z = R[2, 0] * x[m, 0] + R[2, 1] * x[m, 1] + R[2, 2]
        a = (R[0, 0] * x[m, 0] + R[0, 1] * x[m, 1] + R[0, 2]) / z
        b = (R[1, 0] * x[m, 0] + R[1, 1] * x[m, 1] + R[1, 2]) / z
        left_u, left_v = (y[m, 0] - a) * focal_px, (y[m, 1] - b) * focal_px
        robust = w[m] / (1.0 + (left_u * left_u + left_v * left_v) / (level_px * level_px)) ** 2
        J[0, 0], J[0, 1], J[0, 2] = -a * b * focal_px, (1.0 + a * a) * focal_px, -b * focal_px
        J[1, 0], J[1, 1], J[1, 2] = -(1.0 + b * b) * focal_px, a * b * focal_px, a * focal_px
        for k in range(3):
            rhs[k] += robust * (J[0, k] * left_u + J[1, k] * left_v)
            for other in range(3):
                normal[k, other] += robust * (J[0, k] * J[0, other] + J[1, k] * J[1, other])
    return normal, rhs


def _decompose(E: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The (R, t) of E that puts most points in front of BOTH cameras (one alone admits the twisted pair)."""
    R_1, R_2, t = cv2.decomposeEssentialMat(E)
    t = t.ravel()
    candidates = [(R, sign * t) for R in (R_1, R_2) for sign in (1, -1)]

    def share_ahead(motion: tuple[np.ndarray, np.ndarray]) -> float:
        R, t = motion
        d, _ = triangulate(R, t, x, y)
        z_second = (_homogeneous(x) @ R.T)[:, 2] + d * t[2]
        return float(((d > 0) & (z_second > 0)).mean())

    return max(candidates, key=share_ahead)


def _sampson_system(
    R: np.ndarray, t: np.ndarray, across: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix [5, 5] and gradient [5] of the Sampson errors by the left rotation vector and two tangents of t."""
    T = lie.skew(t)
    directions = np.concatenate([T @ GENERATORS, lie.skew(across)]) @ R
    return _sum_normal(T @ R, directions.reshape(5, 9), x, y, w, sigma)


@njit(cache=True, fastmath=True, error_model="numpy")
def _sum_normal(
    E: np.ndarray, directions: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sum robust normal equations over the matches; `directions` [n, 9] are the derivatives of E by the unknowns."""
    n_unknowns = len(directions)
    normal, gradient = np.zeros((n_unknowns, n_unknowns)), np.zeros(n_unknowns)
    by_E, J = np.empty(9), np.empty(n_unknowns)
    for m in range(len(x)):
        X, Y = (x[m, 0], x[m, 1], 1.0), (y[m, 0], y[m, 1], 1.0)
        n, g, line_y0, line_y1, line_x0, line_x1 = sampson_terms(E, X[0], X[1], Y[0], Y[1])
        lines_y, lines_x, ratio = (line_y0, line_y1, 0.0), (line_x0, line_x1, 0.0), n / g**3
        # d(n / g) / dE = (y x^T) / g - n / g^3 ((E x)_top x^T + y (E^T y)_top^T)
        for a in range(3):
            for b in range(3):
                by_E[3 * a + b] = Y[a] * X[b] / g - ratio * (lines_y[a] * X[b] + Y[a] * lines_x[b])
        residual = n / g
        robust = w[m] / (1.0 + (residual / sigma) ** 2) ** 2
        for k in range(n_unknowns):
            J[k] = 0.0
            for c in range(9):
                J[k] += directions[k, c] * by_E[c]
        for k in range(n_unknowns):
            gradient[k] += robust * residual * J[k]
            for other in range(n_unknowns):
                normal[k, other] += robust * J[k] * J[other]
    return normal, gradient


def _tangent_basis(t: np.ndarray) -> np.ndarray:
    """Two orthogonal unit vectors [2, 3] across the unit vector t, built from the axis furthest from it."""
    first = GENERATORS[np.argmin(np.abs(t))] @ t
    first = first / np.linalg.norm(first)
    return np.stack([first, lie.skew(t) @ first])


def _homogeneous(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)
