"""Rows of the mask table: the motion prior and the refined masks of every round against true motion masks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluate import mask_metrics
from stages.shared.artifacts import read_dense
from stages.shared.frame_store import PackedMasks
from stages.shared.images import enlarge
from stages.shared.log import progress

PRIOR_THRESHOLD = 0.5
PRIOR = "motion prior"
"""Name of the prior above one half; any other method of the table is the masks that the run used."""


def read_prior_masks(path: Path, width: int, height: int) -> PackedMasks:
    """The motion prior above one half, at full size [H, W], by frame number."""
    prior = read_dense(path)
    size = (width, height)
    enlarged = (enlarge(p.astype(np.float32), size) for p in prior["probability"])
    return PackedMasks((int(n), p > PRIOR_THRESHOLD) for n, p in zip(prior["frame"], enlarged, strict=True))


def score_masks(
    name: str,
    rounds: Mapping[int, Mapping[str, Mapping[int, np.ndarray]]],
    truth: Mapping[int, np.ndarray],
    source: str,
    movers: Mapping[int, np.ndarray],
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per round and method, and rows per frame of the last round.

    Args:
        rounds: by round, masks by method (`PRIOR`, and the name of the masks used) and frame number.
        truth: true masks by frame number; without any, only the share of dynamic pixels is computed.
        source: source of the true masks.
        movers: masks of what moves in any frame of the clip, by frame number; without any, they are not compared with.
    """
    table, frames, last = [], [], max(rounds)
    for k, methods in rounds.items():
        for method, masks in methods.items():
            title = f"masks of round {k}: {method}"
            scored = {n: _score(masks[n], truth[n]) for n in progress(list(masks), title) if n in truth}
            iou, boundary_f = np.mean(list(scored.values()), axis=0).tolist() if scored else (None, None)
            row = {"sequence": name, "method": method, "round": k, "iou": iou, "boundary_f": boundary_f}
            of_movers = [mask_metrics.iou(masks[n], movers[n]) for n in masks if n in movers]
            row["mover_iou"] = float(np.mean(of_movers)) if of_movers else None
            row["precision"], row["recall"] = mask_metrics.precision_recall((masks[n], truth[n]) for n in scored)
            shares = {
                "dynamic_percent": 100 * float(np.mean([mask.mean() for mask in masks.values()])),
                "true_percent": 100 * float(np.mean([truth[n].mean() for n in scored])) if scored else None,
            }
            about = f"after round {k} of {last}; truth: {source}"
            table.append(row | shares | {"frames": len(scored), "protocol": about})
            if k == last:
                frames += [
                    {"method": method, "frame": n, "iou": i, "boundary_f": f} for n, (i, f) in sorted(scored.items())
                ]
    return table, frames


def _score(mask: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    return mask_metrics.iou(mask, truth), mask_metrics.boundary_f(mask, truth)
