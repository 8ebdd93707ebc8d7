"""Images of depth and masks, and the fly-through as a video."""

from pathlib import Path

import cv2
import numpy as np

from stages.export.clip import Clip
from stages.shared.artifacts import write_json
from stages.shared.errors import InputError
from stages.shared.images import numbered_frames, read_rgb, write_image
from stages.shared.log import progress
from stages.shared.masks import read_burnt_in
from stages.shared.pace import seconds_per_frame

LEVELS = 65535
"""The largest number in a 16-bit image; 0 stands for an unknown depth."""
FARTHEST = 20.0
"""Depths beyond this multiple of the median are left out of the 16-bit images, whose steps would be too coarse."""
CODECS = ("vp09", "mp4v")
"""Codecs of the video in order of preference: VP9, which browsers play, then MPEG-4, which most browsers do not."""


def depth_scale(clip: Clip) -> float:
    """Scene units per step of the depth images, of which the last is the farthest known depth or FARTHEST medians."""
    depth = 1 / clip.inverse_depth[clip.known]
    return float(min(depth.max(), FARTHEST * np.median(depth)) / LEVELS) if len(depth) else 1.0


def encode_depth(depth: np.ndarray, known: np.ndarray, scale: float) -> np.ndarray:
    """Depth [H, W] in scene units as uint16: depth = scale x number; 0 where it is not `known` or too far."""
    steps = np.round(depth / scale)
    return np.where(known & (steps <= LEVELS), steps, 0).astype(np.uint16)


def write_depths(folder: Path, clip: Clip) -> None:
    """Write the depth of every frame as a 16-bit PNG, and scale.json, into `folder`."""
    scale = depth_scale(clip)
    for k, number in enumerate(progress(clip.content.numbers, "depth")):
        write_image(depth_path(folder, number), encode_depth(clip.depth(k), clip.depth_known(k), scale))
    meaning = "z-depth in scene units = scale x number; 0: not triangulated, moving or farther than 65535 x scale"
    write_json(folder / "scale.json", {"scale": scale, "meaning": meaning})


def depth_path(folder: Path, number: int) -> Path:
    """Where the depth image of the frame with this number lies."""
    return folder / f"frame_{number:04d}.png"


def write_masks(folder: Path, clip: Clip) -> None:
    """Write the mask of every frame in COLMAP's naming, <image name>.png.

    Black is ignored: what moves, and what is burnt into the frames.
    """
    burnt_in = read_burnt_in(clip.content)
    for k, name in enumerate(clip.names):
        ignored = clip.mask(k) if burnt_in is None else clip.mask(k) | burnt_in
        write_image(folder / f"{name}.png", ~ignored)


def write_video(path: Path, renders: Path, times_s: list[float] | None) -> str:
    """Write the fly-through of `renders` as a video without its odd last row or column, and return its codec.

    It has the pace of the GIF, by the time stamps [T] of the frames, if any.

    Raises:
        InputError: if there is no fly-through, or OpenCV has no encoder.
    """
    files = list(numbered_frames(renders / "novel").values())
    if not files:
        raise InputError(renders / "novel", "frames of the fly-through", "none", "run the render stage again")
    hz = 1 / seconds_per_frame(times_s, len(files))
    height, width = (size // 2 * 2 for size in read_rgb(files[0]).shape[:2])
    for codec in CODECS:
        video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), hz, (width, height))
        if video.isOpened():
            break
    else:
        advice = "leave `video` out of `export: {formats: ...}`; the GIF is in figures/"
        raise InputError(path, f"an OpenCV that encodes one of {', '.join(CODECS)}", "none", advice)
    for file in files:
        video.write(np.ascontiguousarray(read_rgb(file)[:height, :width, ::-1]))
    video.release()
    return codec
