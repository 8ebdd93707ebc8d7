"""Rounds that begin with the same cameras as the round before: what they would find, that round has found."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import (
    Cameras,
    frame_from_grid,
    pixel_grid,
    projection,
    read_cameras,
    read_readout,
    static_flow,
)
from stages.shared.errors import InputError

SAME_PX, GAPS = 0.1, (1, 8)
"""Flow of the static scene over so many frames that differs by less counts as the same: evidence is weighed against
noise of .35 px and more. Of 113 solved clips 104 ended their third round below this, 102 of these below .06, and nine
at .37 and more."""


class Solved(NamedTuple):
    """Poses and depth that a round ended with; both None in the rounds that have none before them."""

    poses: Path | None
    depth: Path | None


def results_to_keep(last: Solved, earlier: Solved, results: Sequence[Path | None], flow: Path | None) -> list[Path]:
    """The results of the round before, if this one begins as that one did; [] if not, or if there are none.

    Args:
        last, earlier: what the round before ended and began with. results: what it made of that, and of `flow`.

    Raises:
        InputError: if some of these files are given and others not.
    """
    given = [file for file in (*earlier, *results) if file is not None]
    if not given:
        return []
    if len(given) < len(earlier) + len(results) or last.poses is None or last.depth is None or flow is None:
        expected = "together with --earlier-depth, --previous-poses, --previous-depth and what that round made of them"
        raise InputError("--earlier-poses", expected, "only some of them", "give all or none")
    scale = float(read_metadata(flow)["scale"])
    return given[len(earlier) :] if is_settled((last.poses, last.depth), (given[0], given[1]), scale) else []


def is_settled(last: tuple[Path, Path], earlier: tuple[Path, Path], scale: float) -> bool:
    """Whether two rounds in a row ended with the same static world, by what its flow over GAPS would be.

    Compared is the median over each frame, of which movers may cover a part, beside what the readout of a rolling
    shutter moves. Both are to know what moves, as from the second round on: without masks, the depth of a mover is that
    of something static.

    Args:
        last, earlier: poses and depth. scale: pixels of the flow grid, in which SAME_PX is, per pixel of the frame.
    """
    now, then = (read_cameras(poses) for poses, _ in (last, earlier))
    depths = [read_dense(depth)["inverse_depth"] for _, depth in (last, earlier)]
    if depths[0].shape != depths[1].shape or list(now.status) != list(then.status):
        return False
    stride_px = float(read_metadata(last[1])["stride_px"])
    readout = abs(read_readout(last[0]) - read_readout(earlier[0]))
    for gap in GAPS:
        flows = zip(_flows(now, depths[0], stride_px, gap), _flows(then, depths[1], stride_px, gap), strict=True)
        if any(scale * _change(*pair, readout) >= SAME_PX for pair in flows):
            return False
    return True


def _flows(cameras: Cameras, inverse_depth: np.ndarray, stride_px: float, gap: int) -> Iterator[np.ndarray]:
    """Flow [h, w, 2] px of the static scene from each frame to that `gap` frames on, in cells of its depth [T, h, w];
    nan behind a camera."""
    uv = frame_from_grid(pixel_grid(*inverse_depth.shape[1:]), stride_px)
    for k in range(len(inverse_depth) - gap):
        camera, other = ((cameras.cam_from_world[j], cameras.Ks[j]) for j in (k, k + gap))
        flow, ratio = static_flow(uv, np.asarray(inverse_depth[k], float), *projection(camera, other))
        yield np.where(ratio[..., None] > 0, flow, np.nan)


def _change(now: np.ndarray, then: np.ndarray, readout: float) -> float:
    """Median difference of two flows [h, w, 2], and at most what a change of the `readout`, in frames, moves; infinite
    if no pixel has both."""
    differences = np.linalg.norm(now - then, axis=-1) + readout * np.linalg.norm(now, axis=-1)
    known = differences[np.isfinite(differences)]
    return float(np.median(known)) if known.size else np.inf
