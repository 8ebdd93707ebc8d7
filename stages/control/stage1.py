"""Stage 1, from tracks to a fitted motion model: canonical frame, control points, initialisation, fit, residual."""

from typing import Any

import numpy as np
import torch

from stages.control import adapt, canonical, distil, fitting
from stages.control.fitting import NEIGHBOURS, TrackPositions
from stages.control.options import ControlOptions
from stages.control.rest import LONG_FRAMES, rest_positions, seed_from_tracks, worth_of
from stages.control.sightings import Sightings
from stages.deformation import lbs
from stages.deformation.motion_models import Deformation, MLPDeformation, TableDeformation
from stages.shared.cameras import Cameras
from stages.shared.log import logger

POINTS = 1000
"""Where the user does not set their number; fewer where there are fewer tracks. Instead of 256, or of 512 where a mover
bends, held-out movers gain 0.9 dB in exposure_drift, 0.7 in soft_body, 0.1 in splitting, and lose 0.1 in
pure_rotation."""
MIN_ARAP, ARAP_PER_PX = 0.05, 0.5
MAX_EXTENT = 2.0
"""Largest extent of the control points, in median depths of the tracks. A mover extends over about half its depth, a
whole scene with sky over a thousand median depths; steps in units of that extent would be a thousand pixels long."""


def fit_sightings(
    sightings: Sightings, cameras: Cameras, max_arap: float, options: ControlOptions
) -> tuple[Deformation | None, dict[str, Any]]:
    """The fitted motion and its metadata; None if there is no track to fit.

    A fit that is stuck is repeated from another canonical frame; the better one is kept.

    Args:
        max_arap: the largest rigidity, for noisy tracks (`arap_weight` of scene.json).

    Returns:
        the model, and metadata with `status`: "fitted", "stuck" (the residual is too large) or the reason for no model.
    """
    if sightings.n == 0:
        return None, {"status": "no dynamic pixel could be tracked", "arap_weight": 0.0, "region": options.region}
    fits: list[tuple[Deformation, dict[str, Any]]] = []
    for frame in _canonical_frames(sightings):
        fits.append(_fit(sightings, cameras, frame, max_arap, options))
        if not fits[-1][1]["stuck"]:
            break
        logger.warning("attempt %d is stuck: p90 %.2f px", len(fits), fits[-1][1]["p90_px"])
    model, report = min(fits, key=lambda fitted: fitted[1]["p90_px"])
    return model, {
        "status": "stuck" if report["stuck"] else "fitted",
        "kind": options.model,
        "region": options.region,
        "attempts": len(fits),
        "tracks": sightings.n,
        "training_frames": cameras.numbers[sightings.frames].tolist(),
        "options": options.model_dump(),
        **report,
    }


def _canonical_frames(sightings: Sightings) -> list[int]:
    """The training frame to fit from, and the one to try if that fit is stuck: one that sees tracks.

    In a long clip a canonical frame of another visit of a mover would come with the same moments (`rest_positions`): it
    is not tried.
    """
    worth = worth_of(sightings)
    first, second = canonical.choose_frames(worth)
    if worth[second] == 0:
        return [first]
    same_visit = bool(worth[min(first, second) : max(first, second)].all())
    return [first, second] if same_visit or len(sightings.frames) <= LONG_FRAMES else [first]


def _fit(
    sightings: Sightings, cameras: Cameras, frame: int, max_arap: float, options: ControlOptions
) -> tuple[Deformation, dict[str, Any]]:
    """One attempt, with the canonical training frame `frame`: the model and its report."""
    torch.manual_seed(options.seed)
    rest, own = rest_positions(sightings, frame)
    seen = _observations(rest, sightings, cameras)
    table, arap_weight = _fit_table(rest, sightings, seen, max_arap, options)
    model: Deformation = table
    report = fitting.residual_report(model, seen)
    if options.model == "mlp":
        report = {f"table_{name}": value for name, value in report.items()}
        model = MLPDeformation(
            table.points,
            table.log_radii.detach(),
            options.width,
            time_frequencies=options.time_frequencies,
            max_extent=float(table.extent),
        )
        distil.distil(table, model, options.seed)
        fitting.fit(model, seen, options.steps, options.learning_rate, arap_weight, options.seed)
        report |= fitting.residual_report(model, seen)
    return model, {
        "canonical_frame": int(cameras.numbers[sightings.frames[frame]]),
        "control_points": len(model.points),
        "arap_weight": arap_weight,
        "tracks_with_own_rest_moment": own,
        "visible_in_canonical": float((sightings.frame == frame).sum() / sightings.n),
        **report,
    }


def _fit_table(
    rest: np.ndarray,
    sightings: Sightings,
    seen: TrackPositions,
    max_arap: float,
    options: ControlOptions,
) -> tuple[TableDeformation, float]:
    """The fitted table of control points, and the ARAP weight of the second half of the steps.

    `added_share` of the points are added after the first half, where the gradient is high. Rigidity raises the
    held-out residual on clean tracks (8 % at weight 0.5) and lowers it on noisy ones (3 % at 1 px of noise), so the
    weight of the second half follows the residual of the first.
    """
    count = POINTS if options.control_points == "auto" else options.control_points
    added = int(options.added_share * count) if options.steps > 0 else 0
    table = _new_table(rest, sightings, count - added)
    arap_weight = MIN_ARAP if options.arap == "auto" else options.arap
    fitting.fit(table, seen, options.steps // 2, options.learning_rate, arap_weight, options.seed)
    if options.arap == "auto":
        median_px = float(fitting.residual_report(table, seen)["median_px"])
        arap_weight = min(max(MIN_ARAP, ARAP_PER_PX * median_px), max(MIN_ARAP, max_arap))
    if added:
        table = _with_more_points(table, seen, count)
    fitting.fit(table, seen, options.steps - options.steps // 2, options.learning_rate, arap_weight, options.seed + 1)
    return table, arap_weight


def _with_more_points(table: TableDeformation, seen: TrackPositions, count: int) -> TableDeformation:
    """The table with points added up to `count` where the gradient is high; points that no track uses are removed."""
    P = len(table.points)
    index, sq_dist = lbs.neighbours(table.points, seen.canonical, NEIGHBOURS)
    with torch.no_grad():
        weights = lbs.lbs_weights(sq_dist, table.log_radii, index)
    gradients = fitting.position_gradients(table, seen)
    places = adapt.new_places(seen.canonical, weights, index, gradients, P, count - P)
    return adapt.regrow(table, adapt.used(index, P), places, NEIGHBOURS)


def _new_table(rest: np.ndarray, sightings: Sightings, count: int) -> TableDeformation:
    """Control points spread over the tracked points, denser where these move fast, with initial motion."""
    speed = [canonical.speeds(*sightings.spread(sightings.uv, block)) for block in sightings.blocks()]
    importance = canonical.motion_importance(np.concatenate(speed))
    points = rest[canonical.farthest_points(rest, importance, count)]
    log_radii = torch.from_numpy(np.log(canonical.kernel_radii(points))).float()
    max_extent = MAX_EXTENT * float(np.median(sightings.depth))
    table = TableDeformation(torch.from_numpy(points), log_radii, torch.from_numpy(sightings.times), max_extent)
    seed_from_tracks(table, rest, sightings)
    return table


def _observations(rest: np.ndarray, sightings: Sightings, cameras: Cameras) -> TrackPositions:
    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return TrackPositions(
        torch.from_numpy(rest),
        torch.from_numpy(sightings.track),
        torch.from_numpy(sightings.frame),
        tensor(sightings.uv),
        tensor(sightings.depth),
        tensor(sightings.depth_std),
        torch.from_numpy(np.asarray(sightings.times, np.float64)),
        tensor(cameras.cam_from_world[sightings.frames]),
        tensor(cameras.Ks[sightings.frames]),
    )
