"""Colours of static points in all training frames: what the models of light are fitted to and judged on."""

from typing import NamedTuple

import cv2
import numpy as np

from stages.scene.geometry import MIN_CONFIDENCE
from stages.scene.observed import Observed, static_motion
from stages.scene.windows import SMOOTH_PX, TAP_WEIGHTS, TAPS, WIDEST, Windows, windows
from stages.shared import lie
from stages.shared.cameras import pixel_grid, project, unproject
from stages.shared.frame_store import Computed, Frames
from stages.shared.images import DISPLAY_GAMMA
from stages.shared.light import BRIGHT, DARK
from stages.shared.log import progress
from stages.shared.warp import bilinear

SPANS = (1.0, 2**0.5, WIDEST)
"""Widths of the smoothed images, in SMOOTH_PX, between which colours are interpolated by their variance."""
DEPTH_TOLERANCE = 0.05
FRAMES_PER_REFERENCE, MIN_REFERENCES = 4, 3
"""Points are taken from every so-manieth frame, and from no fewer frames than that."""
SAMPLES, MAX_SIGHTINGS, LEAST_SAMPLES = 2400, 150_000, 700
"""Points, and the product of points and frames, at most; a long clip may exceed it for at most LEAST_SAMPLES points."""
GROUP_PX, TEXTURED_GROUP_PX = 5, 3
"""Side of the square of four points, mostly on the same surface: of flat ones; of those of any contrast."""
GROUP = 4
MISFIT_PX, LOOKED_AT = 0.5, 2
"""Pose and depth explain the flow to its nearest frames, two of them, to so many px, or are wrong there."""
MARGIN = 2.0
"""Standard deviations of the smoothing: nearer to movers, and to what is burnt in, it mixes their colours in."""
HELD_BYTES = 400_000_000
"""Memory for smoothed frames."""
MIN_SIGHTINGS = 4
CELLS = (4, 6)
"""Rows and columns of the cells of space per image that are held out in turn."""


class Sightings(NamedTuple):
    """n static points, n a multiple of GROUP, four neighbours behind one another, in F frames.

    Attributes:
        colours: [n, F, 3] 0..1, as stored in the frames, of linear radiance that is averaged over the surface.
        usable: [n, F, 3] bool: seen there, not clipped.
        distance: [n, F] from the camera, scene units. off_axis: [n, F] squared distance from the principal point, 1 in
            the corners. cell: [n] number of the cell of space. odd: [n] bool, its half, as on a chessboard.
        points: [n, 3] world. centres: [F, 3] of the cameras.
    """

    colours: np.ndarray
    usable: np.ndarray
    distance: np.ndarray
    off_axis: np.ndarray
    cell: np.ndarray
    odd: np.ndarray
    points: np.ndarray
    centres: np.ndarray


def sight(seen: Observed, textured: bool = False, density: int = 1) -> Sightings:
    """Static points of low contrast, where a misplaced sample changes little, looked up by pose and depth.

    Args:
        textured: points of any contrast instead, close to one another, where pose and depth are seen to be right.
        density: so many times as many points as usual, of a clip that is not long.
    """
    F = len(seen.rgb)
    most = HELD_BYTES // (13 * seen.dynamic[0].size)
    smooth = Computed(F, lambda k: _smoothed(seen.rgb[k]), most // len(SPANS))
    burnt_in = False if seen.scene is None else ~seen.scene  # rests in the image, not in the world
    free = Computed(
        F, lambda k: _free_px(seen.dynamic[k] | burnt_in | (_is_misplaced(seen, k) if textured else False)), most
    )
    points = _points(seen, smooth, free, textured, density)
    placed = zip(*(_place(seen, free[k], k, points) for k in range(F)), strict=True)
    uv, shown, front, free_px = (np.stack(part, axis=1) for part in placed)
    squares, some, all_front = (part.reshape(-1, GROUP, *part.shape[1:]) for part in (uv, shown, front))
    of_squares = windows(squares, some.max(axis=1) & all_front.min(axis=1))
    over = Windows(*(np.repeat(part, GROUP, axis=0) for part in of_squares))
    shown &= (free_px >= MARGIN * over.reach) & _is_within(uv, over, seen.dynamic.shape[1:])
    uv = np.where(shown[..., None], uv, 0.0)
    frames = progress(range(F), "static points")
    colours = np.stack([_colours(smooth[k], uv[:, k], over.of(k)) for k in frames], axis=1)
    usable = shown[..., None] & (colours > DARK) & (colours < BRIGHT)
    radius = (uv - seen.Ks[:, :2, 2]) / (0.5 * np.hypot(*seen.dynamic[0].shape))
    off_axis = np.square(radius).sum(axis=-1).astype(np.float32)
    often = (usable.sum(axis=1) >= MIN_SIGHTINGS).any(axis=1)
    kept = np.repeat(often.reshape(-1, GROUP).all(axis=1), GROUP)
    colours, usable, off_axis, points = (part[kept] for part in (colours, usable, off_axis, points))
    centres = lie.inverse(seen.cam_from_world)[:, :3, 3]
    distance = np.linalg.norm(points[:, None] - centres, axis=-1).astype(np.float32)
    return Sightings(colours, usable, distance, off_axis, *_cells(seen, points, centres), points, centres)


def _is_misplaced(seen: Observed, k: int) -> np.ndarray:
    """Pixels [h, w] of a frame whose flow is unsure, or not that of pose and depth, as where depth has an edge."""
    wrong, rows = np.zeros(seen.dynamic.shape[1:], bool), np.flatnonzero(seen.edges[:, 0] == k)
    for edge in rows[np.argsort(np.abs(seen.offsets[rows]), kind="stable")[:LOOKED_AT]]:
        misfit = seen.flow[edge] - static_motion(seen, *seen.edges[edge])[0]
        wrong |= (np.hypot(misfit[..., 0], misfit[..., 1]) > MISFIT_PX) | (seen.confidence[edge] < MIN_CONFIDENCE)
    return wrong


def _points(
    seen: Observed, smooth: Frames[list[np.ndarray]], free: Frames[np.ndarray], textured: bool, density: int
) -> np.ndarray:
    """World points [n, 3] of groups of four static pixels, flat or of any contrast, of frames spread over the clip."""
    F, h, w = seen.dynamic.shape
    groups = min(density * SAMPLES, max(density * MAX_SIGHTINGS // F, LEAST_SAMPLES)) // GROUP
    count = max(MIN_REFERENCES, min(F // FRAMES_PER_REFERENCE, groups))
    references = np.unique(np.linspace(0, F - 1, count).astype(int))
    groups //= len(references)
    side = TEXTURED_GROUP_PX if textured else GROUP_PX
    corners = side * np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    found = [np.zeros((0, 3))]
    for k in references:
        chosen = _is_usable(stored(smooth[k][0]), free[k] < MARGIN * SMOOTH_PX, textured)
        whole = np.all([chosen[v : h - side + v, u : w - side + u] for v, u in corners], axis=0)
        at = np.argwhere(whole)
        at = at[np.unique(np.linspace(0, len(at) - 1, min(groups, len(at))).astype(int))]
        v, u = np.moveaxis(at[:, None] + corners, -1, 0).reshape(2, -1)
        uv = pixel_grid(h, w)[v, u]
        found.append(unproject(uv, seen.depth[k][v, u], seen.cam_from_world[k], seen.Ks[k]))
    return np.concatenate(found)


def _is_usable(image: np.ndarray, hidden: np.ndarray, textured: bool) -> np.ndarray:
    """Static, well exposed pixels [h, w], of no more than the median contrast or of any."""
    grey = image.mean(axis=-1)
    usable = ~hidden & (grey > DARK) & (grey < BRIGHT)
    if textured or not usable.any():
        return np.asarray(usable)
    contrast = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    return np.asarray(usable & (contrast <= np.median(contrast[usable])))


def _free_px(hidden: np.ndarray) -> np.ndarray:
    """Distance [h, w] px of each pixel to the nearest hidden one, float32; huge without any."""
    return np.asarray(cv2.distanceTransform((~hidden).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def _place(seen: Observed, free: np.ndarray, k: int, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pixels [n, 2] of points in frame k; [n]: whether they are seen, and in front; how far from hidden pixels, px."""
    h, w = free.shape
    z = points @ seen.cam_from_world[k, 2, :3] + seen.cam_from_world[k, 2, 3]
    front = z > 0
    uv = np.zeros((len(points), 2))
    uv[front] = project(points[front], seen.cam_from_world[k], seen.Ks[k])[0]
    inside = front & ((uv >= 0) & (uv <= (w - 1, h - 1))).all(axis=1)
    near = np.abs(bilinear(seen.depth[k], uv) / np.where(inside, z, 1.0) - 1) < DEPTH_TOLERANCE
    return uv, inside & near, front, bilinear(free, uv)


def _taps(uv: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Pixels [..., 3, 2] that windows about uv [..., 2] are averaged over, from tip to tip."""
    return np.asarray(uv[..., None, :] + TAPS[:, None] * along[..., None, :])


def _is_within(uv: np.ndarray, over: Windows, size: tuple[int, ...]) -> np.ndarray:
    """Whether [n, F] the tips of windows about uv [n, F, 2] are in the image of this height and width."""
    taps = _taps(uv, over.along)
    return np.asarray(((taps >= 0) & (taps <= (size[1] - 1, size[0] - 1))).all(axis=(-2, -1)))


def _smoothed(rgb: np.ndarray) -> list[np.ndarray]:
    """Linear radiance [h, w, 3] of a frame, smoothed as widely as SPANS say."""
    linear = cv2.pow(rgb, DISPLAY_GAMMA)
    return [cv2.GaussianBlur(linear, (0, 0), SMOOTH_PX * span) for span in SPANS]


def _colours(images: list[np.ndarray], uv: np.ndarray, over: Windows) -> np.ndarray:
    """Stored colours [n, 3] at pixels uv of a frame, averaged along windows, across them between two images."""
    levels, (variance, along) = np.square(SMOOTH_PX * np.array(SPANS)), over
    below = np.clip(np.searchsorted(levels, variance, side="right") - 1, 0, len(levels) - 2)
    share = ((variance - levels[below]) / (levels[below + 1] - levels[below]))[:, None].astype(np.float32)
    shown = np.stack([np.einsum("ntc,t->nc", bilinear(image, _taps(uv, along)), TAP_WEIGHTS) for image in images])
    at = np.arange(len(uv))
    return stored((1 - share) * shown[below, at] + share * shown[below + 1, at])


def stored(linear: np.ndarray) -> np.ndarray:
    """Colours as stored in frames, 0..1, of linear radiance."""
    return np.asarray(np.maximum(linear, 0) ** np.float32(1 / DISPLAY_GAMMA), np.float32)


def _cells(seen: Observed, points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number [n] and half [n] of the cell of each point: by its direction from the mean camera, in the middle view."""
    F, h, w = seen.dynamic.shape
    rays = (points - centres.mean(axis=0)) @ seen.cam_from_world[F // 2, :3, :3].T
    angles = np.stack([np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2])), np.arctan2(rays[:, 0], rays[:, 2])])
    size = np.array([h / CELLS[0], w / CELLS[1]]) / seen.Ks[F // 2, 0, 0]
    row, column = np.floor(angles / size[:, None]).astype(int)
    _, cell = np.unique(np.stack([row, column], axis=1), axis=0, return_inverse=True)
    return cell.ravel(), (row + column) % 2 == 1
