"""How seconds and memory grow with the size of the problem: power laws fitted to the measured points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.eval.tables import Row

MEASURES = {"wall_s": "wall time", "cpu_s": "CPU time", "peak_mb": "peak memory"}


@dataclass(frozen=True)
class PowerLaw:
    """value = factor * n ** exponent, with the greatest deviation of a point from it."""

    factor: float
    exponent: float
    deviation_percent: float

    def at(self, n: np.ndarray) -> np.ndarray:
        """The value at sizes n [k]."""
        return np.asarray(self.factor * n**self.exponent)


def fit_power_law(n: np.ndarray, values: np.ndarray) -> PowerLaw | None:
    """Least squares on logarithms; None with fewer than three sizes, which any two numbers would fit.

    Args:
        n: [k] sizes > 0.
        values: [k] > 0.
    """
    used = (n > 0) & (values > 0)
    x, y = np.log(n[used].astype(float)), np.log(values[used].astype(float))
    if len(np.unique(x)) < 3:
        return None
    exponent, offset = np.polyfit(x, y, 1)
    deviation = np.abs(np.expm1(y - (exponent * x + offset))).max()
    return PowerLaw(float(np.exp(offset)), float(exponent), 100 * float(deviation))


def series_of(rows: Sequence[Row], axis: str, measure: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Sizes and values by stage along one axis, in order of size, means where a size was measured more than once."""
    found: dict[str, dict[float, list[float]]] = {}
    for row in rows:
        if row["axis"] == axis and row[measure] is not None:
            found.setdefault(row["stage"], {}).setdefault(float(row["n"]), []).append(row[measure])
    return {
        stage: (np.array(sorted(sizes)), np.array([np.mean(sizes[n]) for n in sorted(sizes)]))
        for stage, sizes in found.items()
    }


def fit_rows(rows: Sequence[Row]) -> list[Row]:
    """A row per axis and stage: the exponents, and what the largest size cost."""
    fitted = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        series = {measure: series_of(rows, axis, measure) for measure in MEASURES}
        for stage, (n, seconds) in series["wall_s"].items():
            row: Row = {
                "axis": axis,
                "stage": stage,
                "from": n[0],
                "to": n[-1],
                "points": len(n),
                "wall_s": seconds[-1],
            }
            for measure in MEASURES:
                sizes, values = series[measure].get(stage, (np.zeros(0), np.zeros(0)))
                law = fit_power_law(sizes, values)
                row[f"{measure}_exponent"] = law.exponent if law else None
                row[f"{measure}_deviation"] = law.deviation_percent if law else None
            fitted.append(row)
    return fitted
