"""Evidence from colours: do they change with the view?"""

import cv2
import numpy as np

from stages.scene.exposure import BRIGHT, DARK
from stages.scene.observed import Observed, static_motion
from stages.shared import lie
from stages.shared.cameras import pixel_grid, unproject
from stages.shared.warp import is_inside, warp

REFERENCES = 3
SAMPLES = 4000
DEPTH_TOLERANCE = 0.05
RIDGE = 1e-2
MIN_SIGHTINGS = 3


def view_evidence(seen: Observed, gains: np.ndarray) -> dict[str, float]:
    """How much of the colours' change between frames the viewing direction predicts, on points left out of the fit.

    Static points of low contrast (where a misplaced sample changes little) are looked up in every frame that sees
    them. Per point, a constant colour and spherical harmonics of degree 1 and 2 are fitted to the even sightings and
    judged on the odd ones, and the other way round.

    Returns:
        colour_change: RMS of the change, of 1. gain_degree1, gain_degree2: share of its square that is predicted.
        view_angle_deg: median range of the viewing directions of a point.
    """
    colours, directions, sighted = _sightings(seen, gains)
    even = np.arange(sighted.shape[1]) % 2 == 0
    enough = (sighted[:, even].sum(axis=1) >= MIN_SIGHTINGS) & (sighted[:, ~even].sum(axis=1) >= MIN_SIGHTINGS)
    if not enough.any():
        return {"colour_change": 0.0, "gain_degree1": 0.0, "gain_degree2": 0.0, "view_angle_deg": 0.0}
    colours, directions, sighted = colours[enough], directions[enough], sighted[enough]
    errors = [_left_out_error(colours, _basis(directions, sighted, degree), sighted) for degree in range(3)]
    kept = errors[0] <= np.quantile(errors[0], 0.9)  # the rest saw something else in front
    constant, first, second = (float(error[kept].mean()) for error in errors)
    reference = directions[np.arange(len(directions)), sighted.argmax(axis=1)]
    cosine = np.einsum("nfc,nc->nf", directions, reference)
    angle = np.where(sighted, np.arccos(np.clip(cosine, -1, 1)), 0.0).max(axis=1)
    return {
        "colour_change": float(np.sqrt(constant)),
        "gain_degree1": 1 - first / constant if constant > 0 else 0.0,
        "gain_degree2": 1 - second / constant if constant > 0 else 0.0,
        "view_angle_deg": float(np.degrees(np.median(angle))),
    }


def _sightings(seen: Observed, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours [n, F, 3], unit viewing directions [n, F, 3] and whether seen [n, F] of sampled static points."""
    F = len(seen.rgb)
    adjusted = seen.rgb / np.exp(gains).astype(np.float32)[:, None, None, None]
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 1.5) for image in adjusted])
    centres = lie.inverse(seen.cam_from_world)[:, :3, 3]
    parts = []
    for reference in np.unique(np.linspace(0, F - 1, REFERENCES).astype(int)):
        rows = _flat_static_pixels(smooth[reference], seen.dynamic[reference])
        looked_up = [_look_up(seen, smooth, reference, target, rows) for target in range(F)]
        colours, sighted = (np.stack(part, axis=1) for part in zip(*looked_up, strict=True))
        depth = seen.depth[reference]
        points = unproject(pixel_grid(*depth.shape), depth, seen.cam_from_world[reference], seen.Ks[reference])
        rays = points.reshape(-1, 1, 3)[rows] - centres
        parts.append((colours, rays / np.linalg.norm(rays, axis=-1, keepdims=True), sighted))
    colours, directions, sighted = (np.concatenate(part) for part in zip(*parts, strict=True))
    return colours, directions, sighted


def _flat_static_pixels(image: np.ndarray, dynamic: np.ndarray) -> np.ndarray:
    """At most SAMPLES pixel numbers (row w + column), evenly spread, of static, well exposed, low-contrast pixels."""
    grey = image.mean(axis=-1)
    contrast = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    usable = ~dynamic & (grey > DARK) & (grey < BRIGHT)
    flat = usable & (contrast <= np.median(contrast[usable])) if usable.any() else usable
    rows = np.flatnonzero(flat)
    return rows[:: max(len(rows) // SAMPLES, 1)]


def _look_up(
    seen: Observed, images: np.ndarray, source: int, target: int, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [n, 3] of static pixels of `source` in `target`, and whether they are in view there [n]."""
    motion, ratio = static_motion(seen, source, target)
    flow, expected = motion.astype(np.float32), ratio * seen.depth[source]
    in_view = is_inside(flow) & (np.abs(warp(seen.depth[target], flow) / expected - 1) < DEPTH_TOLERANCE)
    in_view &= warp(seen.dynamic[target].astype(np.float32), flow) == 0
    return warp(images[target], flow).reshape(-1, 3)[rows], in_view.ravel()[rows]


def _basis(directions: np.ndarray, sighted: np.ndarray, degree: int) -> np.ndarray:
    """Polynomials up to `degree` of each point's viewing directions, centred and of unit spread: [n, F, 1, 4 or 10].

    On the unit sphere they span what spherical harmonics of that degree span.
    """
    count = sighted.sum(axis=1)[:, None, None]
    mean = (directions * sighted[..., None]).sum(axis=1, keepdims=True) / count
    x = np.where(sighted[..., None], directions - mean, 0.0)
    spread = np.sqrt(np.square(x).sum(axis=(1, 2), keepdims=True) / count)
    x = x / np.where(spread > 0, spread, 1.0)
    columns = [np.ones_like(x[..., :1])]
    if degree >= 1:
        columns.append(x)
    if degree >= 2:
        columns += [x * x, x * np.roll(x, 1, axis=-1)]
    return np.concatenate(columns, axis=-1)


def _left_out_error(colours: np.ndarray, basis: np.ndarray, sighted: np.ndarray) -> np.ndarray:
    """Mean squared error [n] on left-out sightings: a ridge fit to even frames judged on odd ones, and back."""
    even = np.arange(sighted.shape[1]) % 2 == 0
    total = np.zeros(len(colours))
    for fitted in (even, ~even):
        used = basis * (sighted & fitted)[..., None]
        normal = np.einsum("nfi,nfj->nij", used, basis)
        ridge = RIDGE * normal[:, 0, 0, None] * (np.arange(basis.shape[-1]) > 0)
        normal += ridge[..., None] * np.eye(basis.shape[-1])
        coefficients = np.linalg.solve(normal, np.einsum("nfi,nfc->nic", used, colours))
        error = np.square(colours - basis @ coefficients).mean(axis=-1)
        total += (error * (sighted & ~fitted)).sum(axis=1)
    return total / sighted.sum(axis=1)
