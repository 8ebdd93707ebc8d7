"""What belongs to distorted frames carried over to the undistorted ones: pictures, flow and ground truth."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.lens.pinhole import Pinhole, reduced
from stages.shared import sintel
from stages.shared.artifacts import Dense
from stages.shared.cameras import frame_from_grid, grid_from_frame, pixel_grid
from stages.shared.images import read_mask, read_rgb, write_image
from stages.shared.masks import read_burnt_in
from stages.shared.sequences import Sequence
from stages.shared.threads import threaded
from stages.shared.warp import bilinear

EDGES = 16
"""Edges that are carried over together."""
BURNT_IN = "burnt_in.png"
CARRIED = ("frames/*.png", BURNT_IN, "truth/*/*.png", "truth/*/*.flo", "truth/*/*.dpt", "truth/*/*.cam")
"""The files of the folder of undistorted images."""


def carried_grid(columns: Dense, pinhole: Pinhole) -> tuple[tuple[int, int], float]:
    """Size (w, h) of the flow grid of the undistorted frames, and its scale; `columns` as in `carry_flow`."""
    w, h = reduced(pinhole, columns["flow"].shape[2] / pinhole.original[0])
    return (w, h), w / pinhole.width


def carry_flow(columns: Dense, pinhole: Pinhole) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Flow [n, h, w, 2] and confidence [n, h, w], float16, of the undistorted frames, for some edges after the others.

    The match of a pixel is the undistorted match of where the original shows it; none outside of the new image.

    Args:
        columns: of flow/pairs.arrow.
    """
    before = columns["flow"].shape[2] / pinhole.original[0]
    (w, h), after = carried_grid(columns, pinhole)
    longest, grid = 2 * max(w, h), pixel_grid(h, w)
    sources = grid_from_frame(pinhole.in_original(frame_from_grid(grid, 1 / after)), 1 / before)

    def carried(e: int) -> tuple[np.ndarray, np.ndarray]:
        matches = sources + bilinear(columns["flow"][e].astype(np.float32), sources)
        there = grid_from_frame(pinhole.from_original(frame_from_grid(matches, 1 / before)), 1 / after)
        inside = ((there >= -0.5) & (there <= np.array([w, h]) - 0.5)).all(axis=-1)
        confidence = bilinear(columns["confidence"][e].astype(np.float32), sources) * inside
        return np.clip(there - grid, -longest, longest).astype(np.float16), confidence.astype(np.float16)

    for first in range(0, len(columns["source"]), EDGES):
        edges = range(first, min(first + EDGES, len(columns["source"])))
        flow, confidence = zip(*threaded(carried, edges), strict=True)
        columns.release()
        yield slice(edges.start, edges.stop), np.stack(flow), np.stack(confidence)


def carry_images(frames: Sequence, pinhole: Pinhole, folder: Path) -> None:
    """Write the undistorted frames and their ground truth into `folder`, named as the originals."""
    sources = pinhole.sources().astype(np.float32)
    near = np.clip(np.rint(sources).astype(int), 0, np.array(pinhole.original) - 1)
    (folder / "frames").mkdir()

    def picture(path: Path) -> np.ndarray:
        smooth = cv2.remap(read_rgb(path), sources, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(smooth)

    def nearest(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[near[..., 1], near[..., 0]])

    def flow(path: Path) -> np.ndarray:
        matches = pinhole.from_original(near + nearest(sintel.read_flo(path)))
        return np.asarray(matches - pinhole.from_original(near))

    def camera(path: Path, out: Path) -> None:
        K, cam_from_world = sintel.read_cam(path)
        K[:2, 2] -= pinhole.corner
        sintel.write_cam(out, K, cam_from_world)

    def mask(path: Path, out: Path) -> None:
        write_image(out, nearest(read_mask(path)))

    writers: dict[str, Callable[[Path, Path], None]] = {
        "depth": lambda path, out: sintel.write_dpt(out, nearest(sintel.read_dpt(path))),
        "flow": lambda path, out: sintel.write_flo(out, flow(path)),
        **dict.fromkeys(("clean_right", "final_right"), lambda path, out: write_image(out, picture(path))),
        **dict.fromkeys(("camdata_left", "camdata_right"), camera),
        **dict.fromkeys(("motion_mask", "mover_mask", "occlusions", "invalid"), mask),
    }
    for kind in set(writers) & set(frames.truth):
        (folder / "truth" / kind).mkdir(parents=True)
    threaded(lambda path: write_image(frame_in(folder, path), picture(path)), frames.frames)
    burnt_in = read_burnt_in(frames)
    if burnt_in is not None:  # whatever touches it: the pictures are interpolated from neighbouring pixels
        grown = cv2.dilate(burnt_in.astype(np.uint8), np.ones((3, 3), np.uint8))
        write_image(folder / BURNT_IN, cv2.remap(grown, sources, None, cv2.INTER_NEAREST) > 0)
    for kind, files in frames.truth.items():
        if kind in writers:
            threaded(lambda path, kind=kind: writers[kind](path, truth_in(folder, kind, path)), files.values())


def frame_in(folder: Path, path: Path) -> Path:
    """Where the undistorted picture of a frame lies."""
    return folder / "frames" / f"{path.stem}.png"


def truth_in(folder: Path, kind: str, path: Path) -> Path:
    """Where the ground truth of an undistorted frame lies."""
    return folder / "truth" / kind / path.name


def carried_sequence(
    content: dict[str, Any], frames: Sequence, pinhole: Pinhole, folder: Path, told: str
) -> dict[str, Any]:
    """The content of `sequence.json` of the undistorted frames in `folder`; the truth of the lens stays where it is."""
    truth = {
        kind: {
            str(number): str((path if kind == "distortion" else truth_in(folder, kind, path)).resolve())
            for number, path in files.items()
        }
        for kind, files in frames.truth.items()
    }
    return content | {
        "width": pinhole.width,
        "height": pinhole.height,
        "frames": [str(frame_in(folder, path).resolve()) for path in frames.frames],
        "truth": truth,
        "burnt_in": None if frames.burnt_in is None else str((folder / BURNT_IN).resolve()),
        "warnings": [*frames.warnings, told],
    }
