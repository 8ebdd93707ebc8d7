"""The report's picture of the control points: where they are in three frames and where they move."""

import cv2
import numpy as np
import torch

from stages.deformation.motion_models import Deformation
from stages.shared import drawing, images
from stages.shared.cameras import Cameras, grid_from_frame, project
from stages.shared.sequences import Sequence

SHOWN_POINTS = 120
TRAIL_FRAMES = 4
PANEL_PX = 600
GREY_LEVELS = 12
"""Few grey levels keep the file small and the coloured trails legible."""


def trajectories(sequence: Sequence, cameras: Cameras, deformation: Deformation | None) -> np.ndarray:
    """First, middle and last frame with the control points, coloured by canonical position, and their trails.

    A trail covers the neighbouring frames and is projected by the camera of the shown frame, so it shows the motion of
    the point without that of the camera. Without a deformation only the frames are shown.
    """
    panels = []
    columns = 3 if sequence.height > sequence.width else 1
    for frame in drawing.spread(len(sequence.frames), 3):
        panel = _dim(images.read_rgb(sequence.frames[frame]), PANEL_PX // columns)
        if deformation is not None:
            _draw_trails(panel, sequence.width, int(frame), cameras, deformation)
        panels.append(panel)
    return drawing.contact_sheet(panels, columns, width_px=PANEL_PX)


def _dim(rgb: np.ndarray, width_px: int) -> np.ndarray:
    """A dark grey copy [h, width_px, 3] in few levels."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    zoom = width_px / grey.shape[1]
    resized = cv2.resize(grey, (width_px, round(zoom * grey.shape[0])), interpolation=cv2.INTER_CUBIC)
    levels = np.round(cv2.GaussianBlur(resized, (0, 0), 1) / 255 * GREY_LEVELS) * (170 / GREY_LEVELS)
    return np.repeat(levels.astype(np.uint8)[..., None], 3, axis=2)


def _draw_trails(panel: np.ndarray, width: int, frame: int, cameras: Cameras, deformation: Deformation) -> None:
    T, P = len(cameras.numbers), len(deformation.points)
    near = np.arange(max(frame - TRAIL_FRAMES, 0), min(frame + TRAIL_FRAMES + 1, T))
    shown = np.linspace(0, P - 1, min(SHOWN_POINTS, P)).astype(int)
    with torch.no_grad():
        _, translations = deformation(torch.from_numpy(near / max(T - 1, 1)).float())
    moved = (deformation.points + translations).double().numpy()[:, shown]
    uv, z = project(moved, cameras.cam_from_world[frame], cameras.Ks[frame])
    zoom = panel.shape[1] / width
    lines = np.clip(grid_from_frame(uv, 1 / zoom), -1e4, 1e4).round().astype(np.int32)
    now = frame - int(near[0])
    colours = _colours(deformation.points.numpy()[shown])
    for n in np.flatnonzero((z > 0).all(axis=0)):
        cv2.polylines(panel, [np.ascontiguousarray(lines[:, n])], False, colours[n].tolist(), 1, cv2.LINE_AA)
        cv2.circle(panel, lines[now, n].tolist(), 3, colours[n].tolist(), -1, cv2.LINE_AA)


def _colours(points: np.ndarray) -> np.ndarray:
    """RGB colours [n, 3] in 0..255 by rank along the points' longest direction."""
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    rank = np.argsort(np.argsort(along)) / max(len(points) - 1, 1)
    mapped = cv2.applyColorMap((255 * rank).astype(np.uint8)[:, None], cv2.COLORMAP_RAINBOW)
    return np.asarray(mapped[:, 0, ::-1]).astype(int)
