"""Flow that the user hands in: files named by frames, the edges that they belong to, and checks against the frames."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.given import files
from stages.given.arrays import check_size, read_array, read_confidence
from stages.shared import sintel
from stages.shared.errors import InputError
from stages.shared.finite import is_finite
from stages.shared.images import reduce
from stages.shared.sequences import Sequence
from stages.shared.warp import is_inside, warp

Edge = tuple[int, int]

SUFFIXES = (".flo", ".png", ".npy")
OPTION = "flow.source"
UNKNOWN = 1e9
"""Middlebury's .flo files hold larger numbers where flow is not known."""
KITTI_ZERO, KITTI_STEPS = 2**15, 64.0
"""16-bit PNG of KITTI: u and v as 64 x px + 2^15 in red and green, and whether they are known in blue."""
MOST_FAR = 0.1
"""Largest share of the known pixels that may move further than the longer side of the frame."""
MOVING_PX, LEAST_MOVING = 0.5, 0.01
"""Pixels that tell a flow from the opposite one, and the least share of a frame that they must have."""
CLEARLY = 0.75
"""A photometric residual below this share of another is clearly smaller. On 20 simulated scenes that of true flow is
0.06 to 0.48 of that of reversed flow, and 0.08 to 0.66 of that without motion; in fog and noise 0.86 and 0.75."""


@dataclass(frozen=True)
class GivenFlow:
    """Flow on the flow grid.

    Attributes:
        flow: [h, w, 2] float32 px, 0 where it is not known. known: [h, w] bool.
        confidence: [h, w] in 0..1 as the user states it; None if it is left to us.
    """

    flow: np.ndarray
    known: np.ndarray
    confidence: np.ndarray | None


def find_flow(folder: Path, frames: Sequence) -> list[Path]:
    """The files of flow between frames of a sequence; raises as `find_edges`."""
    return list(find_edges(folder, frames).values())


def find_edges(folder: Path, frames: Sequence) -> dict[Edge, Path]:
    """The file of flow of every edge (i, j) of frames (0-based) for which there is one, sorted.

    `frame_0003.flo` leads from frame 3 to frame 4, as in MPI-Sintel, `frame_0003_frame_0001.flo` and `3_1.flo` from
    frame 3 to frame 1. Flow to or from other frames than those of the sequence is left out.

    Raises:
        InputError: if no file belongs to two frames of the sequence, or two files to the same.
    """
    candidates = files.listed(folder, SUFFIXES, "flow", OPTION)
    index = {number: k for k, number in enumerate(frames.numbers)}
    found: dict[Edge, Path] = {}
    for path in candidates:
        i, j = map(index.get, _ends(path.stem, frames))
        if i is None or j is None or i == j:
            continue
        if (i, j) in found:
            expected = f"one file of flow from frame {frames.numbers[i]} to {frames.numbers[j]}"
            raise InputError(folder, expected, f"'{found[i, j].name}', '{path.name}'", "keep one")
        found[i, j] = path
    if not found:
        expected = f"flow between frames {frames.numbers[0]} to {frames.numbers[-1]}, as frame_0001_frame_0002.flo"
        raise InputError(folder, expected, f"'{candidates[0].name}'", "name the files by the numbers of the frames")
    return dict(sorted(found.items()))


def read_flow(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Flow [H, W, 2] float32 px, 0 where it is not known, and where it is known [H, W] bool.

    Raises:
        InputError: for another format, or for NaN and infinity.
    """
    if path.suffix.lower() == ".png":
        return _read_kitti(path)
    flow = sintel.read_flo(path) if path.suffix.lower() == ".flo" else read_array(path, "flow [height, width, 2]", 3)
    if flow.shape[2] != 2:
        raise InputError(path, "flow [height, width, 2]", f"{list(flow.shape)}", "move the axis of u and v to the end")
    if not is_finite(flow):
        advice = "write numbers above 1e9 in .flo where flow is not known, or a confidence of 0"
        raise InputError(path, "finite flow", "NaN or infinity", advice)
    known = (np.abs(flow) < UNKNOWN).all(axis=-1)
    return np.where(known[..., None], flow, 0).astype(np.float32), known


def read_on_grid(path: Path, size: tuple[int, int], grid: tuple[int, int]) -> GivenFlow:
    """The flow of a file for frames of `size` (width, height), reduced to a `reduced_size` `grid` (w, h).

    A pixel of the grid is known if all that it covers is.

    Raises:
        InputError: for another size or format, no known pixel, or flow that leads far out of the frame.
    """
    flow, known = read_flow(path)
    check_size(path, (flow.shape[1], flow.shape[0]), size)
    if not known.any():
        raise InputError(path, "known flow", "none", "leave the file out: that flow is then estimated")
    far = float((np.linalg.norm(flow[known], axis=-1) > max(size)).mean())
    if far > MOST_FAR:
        expected, found = f"flow in pixels, at most {max(size)} px", f"more at {far:.0%} of the pixels"
        raise InputError(path, expected, found, "write the displacement u, v from the first frame to the second, in px")
    beside = files.confidence_file(path)
    sure = None if beside is None else reduce(read_confidence(beside, size).astype(np.float32), grid)
    return GivenFlow(*on_grid(flow, known, grid), sure)


def on_grid(flow: np.ndarray, known: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Flow [H, W, 2] and where it is known [H, W], reduced to a grid (w, h): [h, w, 2] in its pixels, [h, w] bool."""
    reduced = reduce(flow, grid, cv2.INTER_LINEAR) * np.float32(grid[0] / flow.shape[1])
    whole = reduce(known.astype(np.float32), grid) > 1 - 1e-6
    return np.where(whole[..., None], reduced, 0), whole


def check_against_frames(given: Mapping[Edge, GivenFlow], grey: np.ndarray, folder: Path) -> None:
    """Refuse flow that the frames contradict: flow given against its direction, or that explains less than no motion.

    Args:
        grey: [T, h, w] uint8 frames. folder: named in the error.

    Raises:
        InputError: says which.
    """
    for sign in (1, -1):
        found = [misfits(grey[i], grey[j], of) for (i, j), of in given.items() if (j - i) * sign > 0]
        if moving := [of_edge for of_edge in found if of_edge is not None]:
            _refuse_misfit(folder, *np.mean(moving, axis=0))


def _refuse_misfit(folder: Path, along: float, against: float, still: float) -> None:
    found = f"a median difference of {along:.1f} grey levels along it"
    if against < CLEARLY * along:
        advice = "exchange the frames in the names of the files, or the sign of the flow"
        raise InputError(folder, "flow from the first frame of a name to the second", f"{found} and {against:.1f} "
                         "against it: it leads from the second to the first", advice)  # fmt: skip
    if still < CLEARLY * along:
        advice = "check names, units (px) and axes (u right, v down)"
        raise InputError(folder, "flow that explains the frames", f"{found} and {still:.1f} without motion", advice)


def misfits(source: np.ndarray, target: np.ndarray, given: GivenFlow) -> tuple[float, float, float] | None:
    """Median differences of grey levels of two frames [h, w] along the flow, against it, and without motion.

    A change of exposure is removed. Pixels are those that move and whose flow, either way, ends inside the frame; None
    where these are few.
    """
    used = given.known & is_inside(given.flow) & is_inside(-given.flow)
    used &= np.linalg.norm(given.flow, axis=-1) > MOVING_PX
    if used.mean() < LEAST_MOVING:
        return None
    source, target = source.astype(np.float32), target.astype(np.float32)
    residuals = (warp(target, flow)[used] - source[used] for flow in (given.flow, -given.flow, 0 * given.flow))
    along, against, still = (float(np.median(np.abs(r - np.median(r)))) for r in residuals)
    return along, against, still


def _ends(stem: str, frames: Sequence) -> tuple[int, int]:
    """Numbers of the frames from and to which the flow of a file of this name leads; negative ones without numbers."""
    stems = {frame.stem: number for frame, number in zip(frames.frames, frames.numbers, strict=True)}
    if stem in stems:
        return stems[stem], stems[stem] + 1
    word = "|".join(("frame_?", "flow_?", re.escape(frames.frames[0].stem.rstrip("0123456789"))))
    if pair := re.fullmatch(rf"(?:{word})?(\d+)(?:_|-|_to_)(?:{word})?(\d+)", stem, re.IGNORECASE):
        return int(pair[1]), int(pair[2])
    numbers = files.numbers_in(stem)
    return (numbers[-1], numbers[-1] + 1) if numbers else (-1, -1)


def _read_kitti(path: Path) -> tuple[np.ndarray, np.ndarray]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3:
        found = "a file that cannot be decoded" if image is None else f"{image.dtype} {list(image.shape)}"
        raise InputError(path, "16-bit RGB PNG of flow as KITTI's", found, "write .flo, or .npy [height, width, 2]")
    known = image[..., 0] > 0
    flow = (image[..., :0:-1].astype(np.float32) - KITTI_ZERO) / np.float32(KITTI_STEPS)
    return np.where(known[..., None], flow, 0), known
