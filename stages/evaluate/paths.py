"""Rows of the trajectory table: every method's camera centres in one frame of reference."""

from collections.abc import Sequence

import numpy as np

from stages.evaluate.score_poses import Candidate, select
from stages.shared.alignment import DegenerateError, umeyama
from stages.shared.cameras import Cameras
from stages.shared.tables import Row


def path_rows(candidates: Sequence[Candidate], truth: Cameras | None) -> list[Row]:
    """Centres aligned to the truth (else to ours), seen from the first camera: x right, y down, z forward.

    Methods that cannot be aligned are left out; `error` is the distance to the truth in scene units, None without it.
    """
    ours = next((c.cameras for c in candidates if c.method == "ours"), None)
    reference = truth or ours
    if reference is None:
        return []
    rows = _rows("truth", reference, reference.centres, None, reference) if truth else []
    for candidate in candidates:
        cameras = candidate.cameras
        if cameras is None:
            continue
        targets = select(reference, np.isin(reference.numbers, cameras.numbers)).centres
        try:
            scale, R, t = umeyama(cameras.centres, targets)
        except DegenerateError:
            continue
        centres = scale * cameras.centres @ R.T + t
        errors = np.linalg.norm(centres - targets, axis=1) if truth else None
        rows += _rows(candidate.method, cameras, centres, errors, reference)
    return rows


def _rows(
    method: str, cameras: Cameras, centres: np.ndarray, errors: np.ndarray | None, reference: Cameras
) -> list[Row]:
    first = reference.cam_from_world[0]
    seen = (centres @ first[:3, :3].T + first[:3, 3]).tolist()
    listed = [None] * len(seen) if errors is None else errors.tolist()
    return [
        {"method": method, "frame": int(number), "x": x, "y": y, "z": z, "error": error}
        for number, (x, y, z), error in zip(cameras.numbers, seen, listed, strict=True)
    ]
