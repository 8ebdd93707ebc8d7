"""Growth of seconds, memory and disk with the size of the problem: the fit of a constant plus a power of the size."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.shared.tables import Row

MEASURES = {"wall_s": "wall time", "cpu_s": "CPU time", "peak_mb": "peak memory", "output_mb": "disk"}
EXPONENTS = np.linspace(0.1, 3.0, 59)
CONSTANT_SHARE = 0.05
"""Growth by less than this share of the largest value counts as constant."""
OPEN_RANGE = 1.5
"""If exponents over a wider range than this fit about as well, the exponent is not determined."""
TOLERANCE = 0.05
"""Fits with a relative error larger by up to this much count as equally good: timings repeat no better."""


@dataclass(frozen=True)
class Growth:
    """value = fixed + factor * n ** exponent.

    Attributes:
        low, high: range of the exponents that fit about as well.
        deviation_percent: largest deviation of a measured value from the fit.
    """

    fixed: float
    factor: float
    exponent: float
    low: float
    high: float
    deviation_percent: float

    def at(self, n: np.ndarray) -> np.ndarray:
        """The value at sizes n [k]."""
        return np.asarray(self.fixed + self.factor * n**self.exponent)

    def words(self) -> str:
        """The exponent with its range, "constant" or "not determined"."""
        if not self.factor:
            return "constant"
        return (
            "not determined"
            if self.high - self.low > OPEN_RANGE
            else f"{self.exponent:.2f} ({self.low:.2f}..{self.high:.2f})"
        )


def fit_growth(n: np.ndarray, values: np.ndarray) -> Growth | None:
    """The best fit over EXPONENTS, each by non-negative least squares of relative errors; None below three sizes.

    Without the fixed part (process start, imports) the exponent would be too small.

    Args:
        n: [k] sizes. values: [k]. Entries that are not positive are ignored.
    """
    used = (n > 0) & (values > 0)
    n, values = n[used].astype(float), values[used].astype(float)
    if len(np.unique(n)) < 3:
        return None
    fits = [_fit(n / n.max(), values, exponent) for exponent in EXPONENTS]
    errors = np.array([np.abs(fixed + factor * (n / n.max()) ** b - values) / values for fixed, factor, b in fits])
    best = int(np.argmin(np.square(errors).sum(axis=1)))
    fixed, factor, exponent = fits[best]
    deviation = 100 * float(errors[best].max())
    if factor < CONSTANT_SHARE * (fixed + factor):
        mean = float(np.exp(np.log(values).mean()))
        return Growth(mean, 0.0, 0.0, 0.0, 0.0, 100 * float(np.abs(mean / values - 1).max()))
    near = EXPONENTS[errors.max(axis=1) <= errors[best].max() + TOLERANCE]
    ends = float(near.min()), float(near.max())
    return Growth(fixed, factor / n.max() ** exponent, exponent, *ends, deviation)


def _fit(size: np.ndarray, values: np.ndarray, exponent: float) -> tuple[float, float, float]:
    from scipy.optimize import nnls

    (fixed, factor), _ = nnls(
        np.stack([np.ones_like(size), size**exponent], axis=1) / values[:, None], np.ones(len(size))
    )
    return float(fixed), float(factor), float(exponent)


def series_of(rows: Sequence[Row], axis: str, measure: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Sizes [k] and values [k] by stage along one axis, by increasing size; repeated measurements are averaged."""
    found: dict[str, dict[float, list[float]]] = {}
    for row in rows:
        if row["axis"] == axis and row.get(measure) is not None:
            found.setdefault(row["stage"], {}).setdefault(float(row["n"]), []).append(row[measure])
    return {
        stage: (np.array(sorted(sizes)), np.array([np.mean(sizes[n]) for n in sorted(sizes)]))
        for stage, sizes in found.items()
    }


def fit_rows(rows: Sequence[Row]) -> list[Row]:
    """A row per axis and stage: the exponents in words, the fixed part, and the wall seconds at the largest size."""
    fitted = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        series = {measure: series_of(rows, axis, measure) for measure in MEASURES}
        for stage, (n, seconds) in series["wall_s"].items():
            fits = {measure: fit_growth(*found[stage]) for measure, found in series.items() if stage in found}
            row: Row = {"axis": axis, "stage": stage, "from": int(n[0]), "to": int(n[-1]), "sizes": len(n)}
            row |= {f"{measure}_growth": fit.words() if (fit := fits.get(measure)) else None for measure in MEASURES}
            wall = fits["wall_s"]
            row |= {"fixed_s": wall.fixed if wall else None, "wall_s": float(seconds[-1])}
            fitted.append(row | {"deviation_percent": wall.deviation_percent if wall else None})
    return fitted
