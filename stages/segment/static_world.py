"""The cameras and the depth of the round before, on the grid of the flow."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.segment.permanence import DYNAMIC, HALF_WEIGHT
from stages.shared import cameras
from stages.shared.artifacts import Dense, read_dense, read_metadata
from stages.shared.cameras import Cameras, read_readout, scale_intrinsics, usable_cameras
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

MOTION_AGAIN = "run the motion stage again"


class StaticWorld(NamedTuple):
    """Cameras of the round before and what gives depth.

    Attributes:
        Ks: [T, 3, 3] intrinsics of the flow grid.
        inverse_depth: gives that of the adjustment [h, w], in which what was masked has the depth of a mover.
        as_static: gives the one [h, w] at which the flow of each pixel fits a static scene best, whatever was masked,
            and where [h, w] bool it fits, and counts at least half.
        of_rows: gives `RollingShutter.projection`, if the rows of a frame are exposed in turn.
    """

    cameras: Cameras
    Ks: np.ndarray
    inverse_depth: Callable[[int], np.ndarray]
    as_static: Callable[[int], tuple[np.ndarray, np.ndarray]]
    of_rows: Callable[[int, int], tuple[np.ndarray, np.ndarray]] | None = None

    def observed(self, i: int, j: int) -> bool:
        """Whether the cameras of both frames were found."""
        return "unobserved" not in self.cameras.status[[i, j]]

    def projection(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """`cameras.projection` of pixels of frame i into frame j, or that of every row."""
        if self.of_rows:
            return self.of_rows(i, j)
        source, target = ((self.cameras.cam_from_world[k], self.Ks[k]) for k in (i, j))
        return cameras.projection(source, target)


def static_world(
    frames: Sequence, evidence: Dense, prior: Path, flow: Path, poses: Path | None, depth: Path | None
) -> StaticWorld | None:
    """The cameras and the depth of the round before on the flow grid; None if there are none.

    Args:
        evidence: the content of the prior, from these cameras. flow: pairs.arrow. poses: poses.parquet.
            depth: depth.arrow.
    """
    found = usable_cameras(poses, depth, "masks come from the prior alone")
    if found is None or poses is None or depth is None:
        return None
    if "static_depth" not in evidence:
        raise InputError(prior, "column 'static_depth' beside cameras", f"columns {sorted(evidence)}", MOTION_AGAIN)
    from stages.shared.static_flow import resample  # compiled code, which masks from elsewhere spare

    h, w = evidence["probability"].shape[1:]
    scale = float(read_metadata(flow)["scale"])
    cells, cell_px = read_dense(depth)["inverse_depth"], float(read_metadata(depth)["stride_px"]) * scale

    def as_static(k: int) -> tuple[np.ndarray, np.ndarray]:
        fits = (evidence["probability"][k] < DYNAMIC) & (evidence["weight"][k] > HALF_WEIGHT)
        return evidence["static_depth"][k].astype(np.float32), fits

    of_rows = None
    if readout := read_readout(poses):
        from stages.shared.rolling import rolling_shutter  # with much of scipy, which other clips spare

        of_rows = partial(rolling_shutter(frames, found, readout, depth, scale).projection, h=h)
    Ks = scale_intrinsics(found.Ks, scale)
    return StaticWorld(found, Ks, lambda k: resample(cells[k : k + 1], cell_px, h, w)[0], as_static, of_rows)
