"""Rows of the pose table: ours in every round, COLMAP in every variant."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluate import pose_diagnostics, trajectory
from stages.shared import lie
from stages.shared.alignment import DegenerateError, extent
from stages.shared.artifacts import read_metadata, read_table
from stages.shared.cameras import Cameras, has_pose, intrinsics, make_cameras, read_cameras
from stages.shared.run_inputs import RunInputs

FOCAL_CURVE = ("focal_curve_mean_percent", "focal_curve_max_percent")
CAMERA_NAMES = {"point": "static", "line": "straight"}


@dataclass(frozen=True)
class Candidate:
    """One method's poses of a sequence.

    Attributes:
        cameras: the k <= total registered frames, ascending; None if there is none.
        failure: why there is none.
        wall_s, cpu_s, threads: seconds of the whole method, and how many threads it had at most. COLMAP gives way to
            our stages, so its wall seconds are meaningless and None; on an idle core its one thread would take its CPU
            seconds.
        taken: what it took from ground truth or from the user, in words.
        decided: decisions of our adjustment, the columns pose_diagnostics.DECISIONS; all None for a baseline.
    """

    method: str
    protocol: str
    total: int
    cameras: Cameras | None
    failure: str | None
    wall_s: float | None
    cpu_s: float
    threads: int
    taken: str | None = None
    decided: Mapping[str, Any] = field(default_factory=lambda: dict.fromkeys(pose_diagnostics.DECISIONS))


def own_candidates(
    tables: Sequence[Path], costs: Sequence[tuple[float, float, int]], inputs: RunInputs
) -> list[Candidate]:
    """Our poses after each round; the last round is called "ours".

    Args:
        costs: wall and CPU seconds until the poses of each round, and the threads.
    """
    candidates = []
    for k, (path, spent) in enumerate(zip(tables, costs, strict=True), start=1):
        cameras, metadata = read_cameras(path), read_metadata(path)
        good = has_pose(cameras)
        method = "ours" if k == len(tables) else f"ours, round {k}"
        source = f"not estimated: {inputs.taken or 'nothing'}"
        protocol = f"{source}; {inputs.masks_in(k)}; after round {k} of {len(tables)}"
        registered = select(cameras, good) if good.any() else None
        failure = (
            None
            if good.any()
            else "; ".join(metadata.get("flags", [])).removeprefix("failed: ") or str(cameras.status[0])
        )
        decided = pose_diagnostics.decisions(metadata)
        candidates.append(Candidate(method, protocol, len(good), registered, failure, *spent, inputs.taken, decided))
    return candidates


def colmap_candidates(*tables: Path) -> list[Candidate]:
    """Every variant of the baseline in these tables, failed ones too."""
    return [candidate for table in tables for candidate in _variants(table)]


def _variants(table: Path) -> Iterator[Candidate]:
    rows = read_table(table)
    for variant in read_metadata(table)["variants"]:
        chosen = {name: column[rows["method"] == variant["method"]] for name, column in rows.items()}
        cameras = None
        if variant["registered"]:
            R = lie.matrix_from_quat(np.stack([chosen[name] for name in ("qw", "qx", "qy", "qz")], axis=-1))
            t = np.stack([chosen[name] for name in ("tx", "ty", "tz")], axis=-1)
            Ks = intrinsics(chosen["fx"], chosen["fy"], chosen["cx"], chosen["cy"])
            cameras = make_cameras(lie.from_parts(R, t), Ks, chosen["frame"])
        names = variant["method"], variant["protocol"], variant["total"]
        costs = None, variant["cpu_s"], variant["threads"]
        yield Candidate(*names, cameras, variant["failure"], *costs, variant["taken"])


def score(name: str, candidate: Candidate, truth: Cameras | None) -> dict[str, Any]:
    """A row of the pose table.

    Without ground truth, or with one that determines no alignment, undefined errors are None and `status` says so.
    """
    row = _empty_row(name, candidate)
    cameras = candidate.cameras
    if cameras is None:
        return row | {"status": "failed", "note": candidate.failure}
    partial = f"only {len(cameras.numbers)} of {candidate.total} frames" if row["registered"] < row["total"] else ""
    if truth is None:
        return row | {"status": "no truth", "note": partial}
    true = select(truth, np.isin(truth.numbers, cameras.numbers))
    row["focal_error_percent"] = trajectory.focal_error_percent(cameras.Ks, true.Ks)
    row |= dict(zip(FOCAL_CURVE, trajectory.focal_curve_percent(cameras.Ks, true.Ks) or (None, None), strict=True))
    try:
        errors = trajectory.pose_errors(cameras.cam_from_world, true.cam_from_world, cameras.numbers)
    except DegenerateError as error:
        return row | _degenerate(error, cameras, true)
    row |= {name: getattr(errors, name) for name in ("ate", "ate_percent", "path")}
    if len(errors.pairs):
        row |= {name: getattr(errors, name) for name in ("rpe_trans", "rpe_rot_deg")}
    note = f"{partial}: errors over these" if partial else ""
    return row | {"status": "partial" if partial else "ok", "note": note}


def _empty_row(name: str, candidate: Candidate) -> dict[str, Any]:
    errors = ("ate", "ate_percent", "rpe_trans", "rpe_rot_deg", "focal_error_percent", "path")
    return {
        "sequence": name,
        "method": candidate.method,
        "protocol": candidate.protocol,
        "registered": 0 if candidate.cameras is None else len(candidate.cameras.numbers),
        "total": candidate.total,
        **dict.fromkeys((*errors, *FOCAL_CURVE)),
        "wall_s": candidate.wall_s,
        "cpu_s": candidate.cpu_s,
        "threads": candidate.threads,
        "taken": candidate.taken,
        **candidate.decided,
    }


def _degenerate(error: DegenerateError, cameras: Cameras, true: Cameras) -> dict[str, Any]:
    """The rotation error, which needs no alignment; the other errors stay None, with the reason in the note."""
    shape = extent(true.centres)
    if shape == "volume":
        which = {"source": "the estimated centres lie", "both": "estimate and truth agree"}[error.which]
        return {"status": "failed", "note": f"{which} on no more than a {error.shape}: no alignment with the truth"}
    poses = lie.inverse(cameras.cam_from_world), lie.inverse(true.cam_from_world)
    _, turns_deg, pairs = trajectory.relative_errors(*poses, cameras.numbers)
    rotation = {"rpe_rot_deg": trajectory.rmse(turns_deg)} if len(pairs) else {}
    status = f"degenerate truth: {CAMERA_NAMES[shape]} camera"
    return {"status": status, "note": "ATE and RPE translation are not defined"} | rotation


def select(cameras: Cameras, chosen: np.ndarray) -> Cameras:
    """The cameras of the frames in `chosen` [T] bool."""
    fields = ("cam_from_world", "Ks", "numbers", "covariance", "status", "masks_trusted")
    return replace(cameras, **{name: getattr(cameras, name)[chosen] for name in fields})
