"""What the decided effects reach and cost against all of them and none of them, and whether that meets the goals."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from stages.shared.tables import Row

GROUP = "effects"
DECIDED, ALL, NONE = "decided", "all", "none"
SETTINGS = (DECIDED, ALL, NONE)
CLOSE_DB, CLOSE_RATIO, TIME_SHARE = 0.1, 1.05, 0.6
"""The goals: at most so much PSNR lost and so many times the ATE of everything on, in this share of its time."""
SAME_DB, SAME_RATIO = 0.01, 1.01
"""What is worse by less than this is not worse: a result without a model that is not there can differ by its noise."""


class Scene(NamedTuple):
    """The rows of the sweep's table of one sequence under the three settings."""

    sequence: str
    decided: Row
    all: Row
    none: Row

    @property
    def runs(self) -> tuple[Row, Row, Row]:
        """Decided, all, none."""
        return self.decided, self.all, self.none


class Against(NamedTuple):
    """One run against another on the same sequence.

    Attributes:
        time_share: of the CPU seconds of the other. model_share: of the size of its model.
        psnr_db, psnr_dynamic_db: held-out PSNR, whole and moving, minus the other's; None where one of them has none.
        ate_ratio: ATE over the other's, infinite where only this run has no complete path, 0 where only the other has
            none, and None where neither has an ATE.
    """

    time_share: float
    model_share: float
    psnr_db: float | None
    psnr_dynamic_db: float | None
    ate_ratio: float | None

    def is_within(self, lost_db: float, ratio: float) -> bool:
        """Whether PSNR is lower by at most `lost_db`, and the ATE at most `ratio` times the other's, where known."""
        psnr_is = self.psnr_db is None or self.psnr_db >= -lost_db
        return psnr_is and (self.ate_ratio is None or self.ate_ratio <= ratio)


class Statement(NamedTuple):
    """A goal, whether it is met, and the figures."""

    goal: str
    is_met: bool
    found: str

    def words(self) -> str:
        """One sentence."""
        return f"{self.goal}: {'yes' if self.is_met else 'no'}; {self.found}."


def scenes_of(costs: Sequence[Row]) -> list[Scene]:
    """The sequences that were run under all three settings, in their order in the sweep's table."""
    found: dict[str, dict[str, Row]] = {}
    for row in costs:
        if row["group"] == GROUP:
            found.setdefault(row["sequence"], {})[row["setting"]] = row
    return [Scene(name, *(runs[s] for s in SETTINGS)) for name, runs in found.items() if set(SETTINGS) <= set(runs)]


def against(run: Row, other: Row) -> Against:
    """One row of the sweep's table against another one of the same sequence."""

    def gain(key: str) -> float | None:
        return None if run[key] is None or other[key] is None else float(run[key] - other[key])

    return Against(
        run["cpu_s"] / other["cpu_s"],
        run["model_mb"] / other["model_mb"],
        gain("psnr_db"),
        gain("psnr_dynamic_db"),
        _ate_ratio(_ate(run), _ate(other)),
    )


def _ate(row: Row) -> float | None:
    """ATE in % of the path; infinite without a complete path, None where it is not defined."""
    return math.inf if row["status"] in ("failed", "partial") else row["ate_percent"]


def _ate_ratio(ate: float | None, other: float | None) -> float | None:
    if ate is None or other is None or (math.isinf(ate) and math.isinf(other)):
        return None
    return ate / other


def statements(scenes: Sequence[Scene]) -> list[Statement]:
    """The three goals over at least one scene."""
    close = [against(scene.decided, scene.all) for scene in scenes]
    better = [against(scene.decided, scene.none) for scene in scenes]
    shares = [pair.time_share for pair in close]
    mean = float(np.mean(shares))
    spent = [float(sum(run["cpu_s"] for run in runs)) for runs in zip(*(scene.runs for scene in scenes), strict=True)]
    return [
        _on_every_scene(
            f"Within {CLOSE_DB} dB and {CLOSE_RATIO - 1:.0%} ATE of everything on",
            scenes,
            close,
            lambda pair: pair.is_within(CLOSE_DB, CLOSE_RATIO),
        ),
        Statement(
            f"At {TIME_SHARE:.0%} of its CPU seconds or less, averaged over the scenes",
            mean <= TIME_SHARE,
            f"{mean:.0%} ({min(shares):.0%} to {max(shares):.0%}), and {spent[0] / spent[1]:.0%} of the sum",
        ),
        _on_every_scene(
            "Never worse than everything off",
            scenes,
            better,
            lambda pair: pair.is_within(SAME_DB, SAME_RATIO),
        ),
    ]


def _on_every_scene(
    goal: str, scenes: Sequence[Scene], pairs: Sequence[Against], holds: Callable[[Against], bool]
) -> Statement:
    missed = [(scene.sequence, pair) for scene, pair in zip(scenes, pairs, strict=True) if not holds(pair)]
    found = f"on {len(scenes) - len(missed)} of {len(scenes)} scenes"
    if missed:
        found += f", not on {', '.join(f'{name} ({in_words(pair)})' for name, pair in missed)}"
    return Statement(goal, not missed, f"{found}; on average {_average(pairs)}")


def _average(pairs: Sequence[Against]) -> str:
    """Mean of the differences of PSNR, and geometric mean of the ratios of ATE that are finite."""
    gains = [pair.psnr_db for pair in pairs if pair.psnr_db is not None]
    ratios = [pair.ate_ratio for pair in pairs if pair.ate_ratio and math.isfinite(pair.ate_ratio)]
    words = [f"{np.mean(gains):+.2f} dB"] if gains else []
    words += [f"ATE {_percent(float(np.exp(np.mean(np.log(ratios)))))} on {len(ratios)} with a path"] if ratios else []
    return ", ".join(words) or "unknown"


def in_words(pair: Against) -> str:
    """Differences of PSNR and ATE, as "-0.31 dB, ATE +12 %"."""
    words = [] if pair.psnr_db is None else [f"{pair.psnr_db:+.2f} dB"]
    if pair.ate_ratio is not None:
        words.append("no complete path" if math.isinf(pair.ate_ratio) else f"ATE {_percent(pair.ate_ratio)}")
    return ", ".join(words)


def _percent(ratio: float) -> str:
    """A ratio as a change; beyond threefold as a factor."""
    return f"{100 * (ratio - 1):+.0f} %" if ratio < 3 else f"{ratio:.3g} times"


def means(scenes: Sequence[Scene], keys: Sequence[str]) -> list[Row]:
    """A row per setting with means of the columns `keys`, each over the scenes that have it under all three settings.

    ATE of a failed or partial path counts as unknown.
    """
    known = {key: [scene for scene in scenes if all(_known(run, key) for run in scene.runs)] for key in keys}
    return [
        {"setting": name}
        | {key: float(np.mean([scene.runs[k][key] for scene in members])) for key, members in known.items() if members}
        for k, name in enumerate(SETTINGS)
    ]


def _known(row: Row, key: str) -> bool:
    return row[key] is not None and not (key == "ate_percent" and row["status"] in ("failed", "partial"))
