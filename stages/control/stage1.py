"""Stage 1 from tracks to a fitted motion model: canonical frame, control points, first motion, fit, residual."""

from typing import Any

import numpy as np
import torch

from stages.control import canonical, fitting, lbs
from stages.control.deformation import Deformation, MLPDeformation, TableDeformation
from stages.control.fitting import NEIGHBOURS, Observations
from stages.control.options import ControlOptions
from stages.control.tracks import Sightings
from stages.shared.cameras import Cameras

CARRIERS = 256
ALONE_RADII = 4.0
TRACKS_PER_POINT = 8


def fit_sightings(
    sightings: Sightings, cameras: Cameras, non_rigid: dict[str, Any], options: ControlOptions
) -> tuple[Deformation | None, dict[str, Any]]:
    """The fitted motion and what to say about it; None where there is no track to fit.

    Args:
        non_rigid: the decision of scene.json: `points` and `arap_weight`.

    Returns:
        the model, and metadata with `status`: "fitted", "stuck" (it leaves too much of the motion unexplained) or why
        there is none.
    """
    if len(sightings.uv) == 0:
        return None, {"status": "no dynamic pixel could be tracked"}
    torch.manual_seed(options.seed)
    frame = canonical.choose_frame(sightings.visible)
    rest, own = rest_positions(sightings.moved, sightings.visible, frame, sightings.times)
    count = non_rigid["points"] if options.control_points == "auto" else options.control_points
    model = _new_model(rest, sightings, count, options)
    seen = _observations(rest, sightings, cameras)
    fitting.fit(model, seen, options.steps, options.learning_rate, non_rigid["arap_weight"], options.seed)
    report = fitting.residual_report(model, seen)
    return model, {
        "status": "stuck" if report["stuck"] else "fitted",
        "kind": options.model,
        "canonical_frame": int(cameras.numbers[sightings.frames[frame]]),
        "tracks": len(rest),
        "tracks_with_own_rest_moment": own,
        "visible_in_canonical": float(sightings.visible[:, frame].mean()),
        "training_frames": cameras.numbers[sightings.frames].tolist(),
        "options": options.model_dump(),
        **report,
    }


def _new_model(rest: np.ndarray, sightings: Sightings, count: int, options: ControlOptions) -> Deformation:
    """Control points spread over the tracked points, densest where they move most, with their first motion."""
    importance = canonical.motion_importance(sightings.uv, sightings.visible)
    points = rest[canonical.farthest_points(rest, importance, count)]
    log_radii = torch.from_numpy(np.log(canonical.kernel_radii(points))).float()
    if options.model == "mlp":
        return MLPDeformation(
            torch.from_numpy(points), log_radii, options.width, time_frequencies=options.time_frequencies
        )
    table = TableDeformation(torch.from_numpy(points), log_radii, torch.from_numpy(sightings.times))
    seed_from_tracks(table, rest, sightings.moved, sightings.visible)
    return table


def _observations(rest: np.ndarray, sightings: Sightings, cameras: Cameras) -> Observations:
    track, frame = np.nonzero(sightings.visible)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return Observations(
        torch.from_numpy(rest),
        torch.from_numpy(track),
        torch.from_numpy(frame),
        tensor(sightings.uv[track, frame]),
        tensor(sightings.depth[track, frame]),
        tensor(sightings.depth_std[track, frame]),
        tensor(sightings.times),
        tensor(cameras.cam_from_world[sightings.frames]),
        tensor(cameras.Ks[sightings.frames]),
    )


def rest_positions(moved: np.ndarray, visible: np.ndarray, frame: int, times: np.ndarray) -> tuple[np.ndarray, int]:
    """Where every track lies in the canonical frame.

    A track seen in `frame` lies where it is seen. Any other is carried there from the sighting nearest in time by the
    motion of the tracks around it; one that enters late or leaves early, far from all others, rests at that sighting:
    its own reference moment.

    Args:
        moved: [n, F, 3] positions in the world. visible: [n, F]. frame: in [0, F), seen by at least one track.
        times: [F] ascending, in 0..1.

    Returns:
        positions float32 [n, 3], and how many tracks rest at a moment of their own.
    """
    anchored = visible[:, frame]
    rest = moved[:, frame].astype(np.float32)
    chosen = canonical.farthest_points(rest[anchored], np.ones(anchored.sum()), CARRIERS)
    points = rest[anchored][chosen]
    carriers = TableDeformation(
        torch.from_numpy(points),
        torch.from_numpy(np.log(canonical.kernel_radii(points))).float(),
        torch.from_numpy(times),
    )
    seed_from_tracks(carriers, rest[anchored], moved[anchored], visible[anchored])
    away = np.abs(np.arange(visible.shape[1]) - frame)
    sighting = np.where(visible, away, visible.shape[1]).argmin(axis=1)
    own = 0
    for k in np.unique(sighting[~anchored]):
        members = np.flatnonzero(~anchored & (sighting == k))
        seen_at = torch.from_numpy(moved[members, k].astype(np.float32))
        with torch.no_grad():
            quats, translations = carriers(carriers.knots[k : k + 1])
        carried, remoteness = lbs.inverse_blend(
            seen_at, carriers.points, quats[0], translations[0], carriers.log_radii, NEIGHBOURS
        )
        alone = remoteness > ALONE_RADII
        rest[members] = torch.where(alone[:, None], seen_at, carried).numpy()
        own += int(alone.sum())
    return rest, own


def seed_from_tracks(
    deformation: TableDeformation, canonical: np.ndarray, moved: np.ndarray, visible: np.ndarray
) -> None:
    """Start the table with the median shift of the tracks nearest to each control point, in place.

    From rest the photometric gradient never finds the motion, and the fit to tracks takes far longer. Rotations start
    at none: those of the Procrustes problem amplify errors of depth, and seed worse than none.

    Args:
        canonical: [n, 3] tracked points. moved: [n, F, 3] where they are in each training frame. visible: [n, F].
    """
    nearest, _ = lbs.neighbours(torch.from_numpy(canonical), deformation.points, TRACKS_PER_POINT)
    shifts = (moved - canonical[:, None])[nearest.numpy()]  # [P, K, F, 3]
    seen = visible[nearest.numpy()]
    known = seen.any(axis=1)
    times = deformation.knots.numpy()
    motion = np.empty((len(times), len(known), 3))
    for p, frames in enumerate(known):  # frames without a sighting lie between those with one
        medians = np.stack([np.median(shifts[p, seen[p, :, f], f], axis=0) for f in np.flatnonzero(frames)])
        motion[:, p] = np.stack([np.interp(times, times[frames], medians[:, axis]) for axis in range(3)], axis=-1)
    with torch.no_grad():
        deformation.table[..., 4:] = torch.from_numpy(motion) / deformation.extent
