"""Rounds that begin with the same cameras as the round before: what they would find, that round has found."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import Cameras, frame_from_grid, pixel_grid, projection, read_cameras, static_flow
from stages.shared.errors import InputError

SAME_PX = 0.1
"""Flow of the static scene that differs by less counts as the same: the noise that evidence is weighed against is at
least .35 px. Of 134 solved clips two thirds end their third round at 0, nine tenths below .03, eight above this."""


class Solved(NamedTuple):
    """Poses and depth that a round ended with; both None in the rounds that have none before them."""

    poses: Path | None
    depth: Path | None


def results_to_keep(last: Solved, earlier: Solved, results: Sequence[Path | None], scale: float) -> list[Path]:
    """The results of the round before, if this one begins as that one did; [] if not, or if there are none.

    Args:
        last, earlier: what the round before ended and began with. results: what it made of that.
        scale: as of `is_settled`.

    Raises:
        InputError: if some of these files are given and others not.
    """
    given = [file for file in (*earlier, *results) if file is not None]
    if not given:
        return []
    if len(given) < len(earlier) + len(results) or last.poses is None or last.depth is None:
        expected = "together with --earlier-depth, --previous-poses, --previous-depth and what that round made of them"
        raise InputError("--earlier-poses", expected, "only some of them", "give all or none")
    return given[len(earlier) :] if is_settled((last.poses, last.depth), (given[0], given[1]), scale) else []


def is_settled(last: tuple[Path, Path], earlier: tuple[Path, Path], scale: float) -> bool:
    """Whether two rounds in a row ended with the same static world, by what its flow to the next frames would be.

    Both must have begun with the poses of a round before: the first knows nothing of movers, and its depth of them is
    that of something static. Compared is the median over each frame, of which movers may cover a part.

    Args:
        last, earlier: poses and depth. scale: pixels of the flow grid, in which SAME_PX is, per pixel of the frame.
    """
    if not all(read_metadata(poses).get("from_previous_round") for poses, _ in (last, earlier)):
        return False
    cameras = [read_cameras(poses) for poses, _ in (last, earlier)]
    if any("failed" in of.status for of in cameras):
        return False
    flows = [_flows(of, depth) for of, (_, depth) in zip(cameras, (last, earlier), strict=True)]
    return all(scale * _change(now, then) < SAME_PX for now, then in zip(*flows, strict=True))


def _flows(cameras: Cameras, depth: Path) -> Iterator[np.ndarray]:
    """Flow [h, w, 2] px of the static scene from each frame to the next, in cells of its depth; nan behind a camera."""
    inverse_depth, stride_px = read_dense(depth)["inverse_depth"], float(read_metadata(depth)["stride_px"])
    uv = frame_from_grid(pixel_grid(*inverse_depth.shape[1:]), stride_px)
    for pair in itertools.pairwise(range(len(inverse_depth))):
        camera, other = ((cameras.cam_from_world[k], cameras.Ks[k]) for k in pair)
        flow, ratio = static_flow(uv, np.asarray(inverse_depth[pair[0]], float), *projection(camera, other))
        yield np.where(ratio[..., None] > 0, flow, np.nan)


def _change(now: np.ndarray, then: np.ndarray) -> float:
    """Median difference of two flows [h, w, 2]; infinite if no pixel has both."""
    difference = np.linalg.norm(now - then, axis=-1)
    known = difference[np.isfinite(difference)]
    return float(np.median(known)) if known.size else np.inf
