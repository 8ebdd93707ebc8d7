"""The shutter that makes two frames, each blurred as the other is, most alike, and how sure that is."""

import numpy as np

TILES = (4, 6)
"""Rows and columns of image tiles: the shutter is fitted to every other one, as on a chessboard, judged on the rest."""
SHUTTERS = np.arange(1, 9) / 8
TESTED = 3
"""Index of the shutter at which the slope <a, b> / <b, b> shows how well it could be told from none: half a frame."""


def judge(sums: np.ndarray, given: float | None) -> dict[str, float]:
    """The evidence about the shutter, as `shutter.shutter_evidence` returns it, from sums [3, SHUTTERS, tiles].

    A tile saves 2 <a, b> - <b, b>: <b, b> if the shutter is right, and -<b, b> on average if there is no blur. How much
    the tiles differ in what they save holds more than chance, since movers fill few of them. So does how much they
    differ from what is expected, if the shutter is a little wrong. Both bound the standard error of the gain: the
    smaller one counts.
    """
    n = sums.shape[-1]
    odd = (np.arange(n) // TILES[1] + np.arange(n) % TILES[1]) % 2 == 1
    saved, expected, before = np.zeros((3, n))
    for fitted in (odd, ~odd):
        shutter = _best(sums[..., fitted]) if given is None else given
        aa, ab, bb = _at(shutter, sums[..., ~fitted])
        saved[~fitted], expected[~fitted], before[~fitted] = 2 * ab - bb, bb, aa
    sigma = min(float(np.sqrt(n) * saved.std(ddof=1)), float(np.linalg.norm(saved - expected)))
    without = [np.delete(sums, tile, axis=-1) for tile in range(n)]
    return {
        "shutter": _best(sums) if given is None else given,
        "shutter_sigma": _jackknife([_best(part) for part in without]) if given is None else 0.0,
        "gain_percent": 100 * float(saved.sum() / max(before.sum(), 1e-12)),
        "gain_sigma_percent": 100 * sigma / max(float(before.sum()), 1e-12),
        "expected_percent": 100 * float(expected.sum() / max(before.sum(), 1e-12)),
        "slope_sigma": _jackknife([float(_slopes(part)[TESTED]) for part in without]),
    }


def _slopes(sums: np.ndarray) -> np.ndarray:
    """<a, b> / <b, b> by shutter, from sums [3, SHUTTERS, n]."""
    _, ab, bb = sums.sum(axis=-1)
    return np.asarray(ab / np.maximum(bb, 1e-12))


def _best(sums: np.ndarray) -> float:
    """The shutter 0..1 whose slope is 1. The slope falls with the square of a short shutter."""
    slopes = _slopes(sums)
    below = np.flatnonzero(slopes < 1)
    if not len(below):
        return float(SHUTTERS[-1])
    k = below[0]
    if k == 0:
        return float(SHUTTERS[0] * np.sqrt(max(slopes[0], 0.0)))
    logs = np.log(np.maximum(slopes[k - 1 : k + 1], 1e-6))
    return float(SHUTTERS[k - 1] + (SHUTTERS[k] - SHUTTERS[k - 1]) * logs[0] / (logs[0] - logs[1]))


def _at(shutter: float, sums: np.ndarray) -> np.ndarray:
    """Sums [3, n] at a shutter, from those [3, SHUTTERS, n]; without one b is zero."""
    knots = np.append(0.0, SHUTTERS)
    none = sums[:, :1] * np.array([1.0, 0.0, 0.0])[:, None, None]
    table = np.concatenate([none, sums], axis=1)
    return np.array([[np.interp(shutter, knots, column) for column in rows.T] for rows in table])


def _jackknife(values: list[float]) -> float:
    """Standard error from values that leave out one part of n each (Efron 1982)."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.square(np.array(values) - np.mean(values)).sum()))
