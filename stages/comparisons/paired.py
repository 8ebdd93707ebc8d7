"""What one part of the method changes: differences to the configured run, paired by sequence, with intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.shared.tables import Row, decimal

LEVEL = 0.95
FEWEST = 3
"""Sequences below which no interval is given."""


@dataclass(frozen=True)
class Effect:
    """A score whose change is stated.

    Attributes:
        key: of the sweep's rows.
        label, unit: the heading of the change.
        ratio: whether the change is a factor, this run over the configured one; else a difference.
        beside: key of the configured run's value, where the row of this run has it; None: that run has a row.
    """

    key: str
    label: str
    unit: str
    ratio: bool = False
    beside: str | None = None


EFFECTS = (
    Effect("ate_percent", "ATE", "factor", ratio=True),
    Effect("iou", "mask IoU", "difference"),
    Effect("psnr_db", "PSNR", "dB"),
    Effect("psnr_static_db", "PSNR static", "dB"),
    Effect("psnr_dynamic_db", "PSNR dynamic", "dB"),
    Effect("model_mb", "model", "factor", ratio=True),
    Effect("cpu_s", "CPU time", "factor", ratio=True),
    Effect("equal_s", "training to equal PSNR", "factor", ratio=True, beside="configured_equal_s"),
)


def changes(rows: Sequence[Row], effect: Effect) -> np.ndarray:
    """The change [n] of a score in every sequence where both runs have it; logarithms of factors.

    Poses that failed or are partial, in either run, have no ATE.

    Args:
        rows: one setting's rows, each with the row of the configured run on the same sequence as `configured`.
    """
    found = []
    for row in rows:
        configured = row["configured"]
        if effect.key == "ate_percent" and {row["status"], configured["status"]} != {"ok"}:
            continue
        pair = row[effect.key], row[effect.beside] if effect.beside else configured[effect.key]
        if None in pair or (effect.ratio and min(pair) <= 0):
            continue
        found.append(np.log(pair[0] / pair[1]) if effect.ratio else pair[0] - pair[1])
    return np.array(found, float)


def interval(values: np.ndarray) -> tuple[float, float]:
    """The mean of n >= 2 values [n], and half of Student's interval around it at the level LEVEL."""
    from scipy import stats  # takes half a second, also of reports without a comparison

    half = stats.t.ppf((1 + LEVEL) / 2, len(values) - 1) * stats.sem(values)
    return float(values.mean()), float(half)


def in_words(values: np.ndarray, effect: Effect) -> str | None:
    """Mean and interval as "+0.42 (+0.10 to +0.74)", with three sequences and more; None without any.

    Factors are means of logarithms.
    """
    if len(values) == 0:
        return None
    mean, half = interval(values) if len(values) >= FEWEST else (float(values.mean()), None)
    ends = [mean] if half is None else [mean, mean - half, mean + half]
    texts = [decimal(float(np.exp(end)), 2) if effect.ratio else f"{end:+.2f}" for end in ends]
    return texts[0] if half is None else f"{texts[0]} ({texts[1]} to {texts[2]})"


def paired(rows: Sequence[Row], group: str) -> list[Row]:
    """A row per setting of a group that is not the configured run: its change of every score, and the sequences.

    Args:
        rows: of the sweep's table, one per sequence and setting.
    """
    configured = {row["sequence"]: row for row in rows if row["is_default"]}
    others: dict[str, list[Row]] = {}
    for row in rows:
        if row["group"] == group and not row["is_default"] and row["sequence"] in configured:
            others.setdefault(row["setting"], []).append(row | {"configured": configured[row["sequence"]]})
    return [
        {"setting": setting, "sequences": len(members)}
        | {effect.key: in_words(changes(members, effect), effect) for effect in EFFECTS}
        for setting, members in others.items()
    ]
