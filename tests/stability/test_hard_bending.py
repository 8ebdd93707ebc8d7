"""Bodies that are hard to tell from bending ones, and bending that is hard to tell."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import body
from numpy.testing import assert_array_equal
from square_inputs import observe

from stages.scene import bending, rigid_motion, rules
from stages.scene.rigid_motion import Patch


def saved_px2(patch: Patch) -> float:
    """Mean squared error that bending saves."""
    stiff, bent = (np.clip(error, -bending.MOST_PX, bending.MOST_PX) for error in bending.held_out_errors(patch))
    return float(np.square(stiff).mean() - np.square(bent).mean())


@pytest.mark.parametrize(
    ("turn_deg", "slope"),
    [
        ((0, 0, 20), 0.0),
        ((0, 12, 0), 0.0),
        ((-10, -8, 0), -0.25),
        ((1, 3, 1), -0.8),
        ((0, 0, 0), 2.5),
        ((-2, 8, 3), 0.4),
    ],
    ids=["wheel", "turntable", "tumbling", "wall", "along the line of sight", "all"],
)
def test_rigid_bodies_do_not_bend(turn_deg: tuple[float, float, float], slope: float) -> None:
    patch = body(turn_deg, slope=slope)
    stiff, _ = bending.held_out_errors(patch)
    assert np.square(stiff).mean() ** 0.5 < 0.1  # of noise of 0.05 px
    assert saved_px2(patch) < (rules.MIN_BENDING_PX / 2) ** 2


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0, 3, 0), (0, 0, 20)])
def test_a_body_that_bends_is_told_whatever_its_motion(turn_deg: tuple[float, float, float]) -> None:
    assert saved_px2(body(turn_deg, strain=0.2)) > (2 * rules.MIN_BENDING_PX) ** 2


def test_wrong_matches_do_not_bend_a_body() -> None:
    """A tenth of the pixels is up to 30 px off, in blocks, in one frame each."""
    patch, random = body(), np.random.default_rng(1)
    for flow in patch.flow:
        hit = (patch.uv // 6).astype(int) @ [1, 31]
        flow[np.isin(hit, random.choice(np.unique(hit), len(np.unique(hit)) // 10, replace=False))] += [20, -22]
    assert saved_px2(patch) < rules.MIN_BENDING_PX**2
    assert saved_px2(patch._replace(flow=patch.flow + body(strain=0.2).flow - body().flow)) > rules.MIN_BENDING_PX**2


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_flow_that_cannot_be_trusted_may_be_anything(value: float) -> None:
    """No sum may meet it: a weight of 0 times NaN is NaN."""
    patch, random = body(strain=0.2), np.random.default_rng(2)
    good = patch.good & (random.random(patch.good.shape) < 0.9)
    numbers, anything = (patch._replace(good=good, flow=np.where(good[..., None], patch.flow, of)) for of in (7, value))
    for expected, found in zip(bending.held_out_errors(numbers), bending.held_out_errors(anything), strict=True):
        assert_array_equal(found, expected)


def test_a_body_at_rest_has_no_depth_and_does_not_bend() -> None:
    patch = body()._replace(flow=np.zeros_like(body().flow))
    assert np.isfinite(rigid_motion.fit(patch).t).all()
    assert saved_px2(patch) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("kept", [0, 1])
def test_movers_whose_flow_is_nowhere_sure_are_not_judged(kept: int) -> None:
    """Or is sure in a single frame, where depth is free to explain anything."""
    seen = observe()
    sure = np.isin(np.arange(len(seen.edges)), [np.flatnonzero(seen.edges[:, 0] == k)[0] for k in range(len(seen.rgb))])
    blind = replace(seen, confidence=np.where(sure[:, None, None] & (kept == 1), seen.confidence, 0))
    assert bending.bending_evidence(blind) == {}
    assert not rules.decide_non_rigid({}, "auto")["needed"]
