"""Motion blur before a panning camera whose speed changes: found, measured, and not mistaken for other effects."""

from typing import Any

import cv2
import numpy as np
import pytest

from stages.scene import blur_rules, shutter
from stages.scene.observed import Observed
from stages.scene.shutter import FIRST_PAIRS, PAIRS, shutter_evidence
from stages.scene.shutter_fit import SHUTTERS, TILES, judge

H, W, F = 72, 128, 12
MEAN_PX, SWING_PX = 4.0, 3.5
"""Speed in px per frame, and how far it swings about that over the clip."""
FAST = np.sin(2 * np.pi * np.arange(F) / F)


def clip(
    shutter: float,
    speeds_px: tuple[float, float] = (MEAN_PX, SWING_PX),
    noise: float = 0.0,
    flow_error_px: float = 0.0,
    magnified: float = 0.0,
    drift: float = 0.0,
) -> Observed:
    """A pan over a textured wall, with exact flow between frames up to six apart, in both directions.

    Args:
        speeds_px: mean and swing. noise: of the radiance. magnified, drift: how much larger and brighter the fastest
            frame shows the wall; the slowest as much smaller and darker.
    """
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.standard_normal((4 * H, 4 * W)).astype(np.float32), (0, 0), 1.2)
    wall = np.clip(0.35 + 0.12 * wall / wall.std(), 0.02, 0.75)
    scales, gains = np.exp(magnified * FAST), np.exp(drift * FAST)
    uv = np.moveaxis(np.mgrid[:H, :W][::-1], 0, -1).astype(float)

    def source(k: int, pixels: np.ndarray, passed: float = 0.0) -> np.ndarray:
        """Where pixels of frame k lie on the wall, a share of a frame later."""
        angle = 2 * np.pi * (k + passed) / F
        travelled = speeds_px[0] * (k + passed) - speeds_px[1] * F / (2 * np.pi) * np.cos(angle)
        return (pixels - (W / 2, H / 2)) / scales[k] + (1.5 * W, 2 * H) + [travelled, 0.0]

    def picture(k: int) -> np.ndarray:
        moments = shutter * ((np.arange(16) + 0.5) / 16 - 0.5)
        places = [np.moveaxis(source(k, uv, passed).astype(np.float32), -1, 0) for passed in moments]
        light = gains[k] * np.mean([cv2.remap(wall, *place, cv2.INTER_CUBIC) for place in places], axis=0)
        return np.clip(light + noise * rng.standard_normal((H, W)), 0, 1) ** (1 / 2.2)

    pairs = [(i, j) for i in range(F) for j in range(F) if 0 < abs(i - j) <= 6]
    flow = np.stack([(source(i, uv) - source(j, np.zeros(2))) * scales[j] - uv for i, j in pairs])
    wrong = [cv2.GaussianBlur(rng.standard_normal((H, W, 2)), (0, 0), 3) for _ in pairs]
    flow += flow_error_px * np.stack(wrong) / np.std(wrong)
    return Observed(
        rgb=np.repeat(np.stack([picture(k) for k in range(F)])[..., None], 3, axis=-1).astype(np.float32),
        dynamic=np.zeros((F, H, W), bool),
        instances=np.zeros((F, H, W), np.uint16),
        depth=np.ones((F, H, W)),
        cam_from_world=np.tile(np.eye(4), (F, 1, 1)),
        Ks=np.tile(np.eye(3), (F, 1, 1)),
        edges=np.array(pairs),
        flow=flow.astype(np.float32),
        confidence=np.ones((len(pairs), H, W), np.float32),
        offsets=np.array([j - i for i, j in pairs]),
    )


def measured(seen: Observed) -> dict[str, float]:
    return shutter_evidence(seen, blur_rules.MIN_SPEED_PX)


def decided(seen: Observed, given: float | None = None) -> dict:
    return blur_rules.decide_motion_blur(shutter_evidence(seen, blur_rules.MIN_SPEED_PX, given), "auto", given)


@pytest.mark.parametrize(("blurred", "pairs"), [(0.0, FIRST_PAIRS), (0.5, PAIRS)])
def test_few_pairs_rule_out_blur_and_never_find_it(blurred: float, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def counted(*args: Any) -> np.ndarray:
        compared.append(args[-1])
        return compare(*args)

    compare = shutter._compare
    monkeypatch.setattr(shutter, "_compare", counted)
    decision = decided(clip(blurred, noise=0.005))
    assert (decision["needed"], decision["observable"]) == (blurred > 0, True)
    assert len(compared) == 2 * pairs


def test_pairs_without_pixels_to_compare_rule_out_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def none_at_first(*args: Any) -> np.ndarray:
        compared.append(args[-1])
        return compare(*args) * (len(compared) > 2 * FIRST_PAIRS)

    compare = shutter._compare
    monkeypatch.setattr(shutter, "_compare", none_at_first)
    assert decided(clip(0.5, noise=0.005))["needed"]
    assert len(compared) == 2 * PAIRS


@pytest.mark.parametrize("open_for", [0.3, 0.6, 0.9])
def test_the_shutter_is_measured(open_for: float) -> None:
    evidence = measured(clip(open_for, noise=0.005))
    assert evidence["shutter"] == pytest.approx(open_for, abs=0.06)
    assert blur_rules.decide_motion_blur(evidence, "auto", None)["needed"]


@pytest.mark.parametrize(
    "effect",
    [
        {},
        {"noise": 0.02},
        {"flow_error_px": 0.3},
        {"magnified": -0.1},
        {"drift": 0.1},
    ],
)
def test_other_differences_between_fast_and_slow_frames_are_no_blur(effect: dict) -> None:
    decision = decided(clip(0.0, **effect))
    assert decision["observable"]
    assert not decision["needed"]
    assert decision["shutter"] is None


def test_blur_is_found_beside_them() -> None:
    evidence = measured(clip(0.5, noise=0.01, flow_error_px=0.2, magnified=0.1, drift=0.1))
    assert evidence["shutter"] == pytest.approx(0.5, abs=0.1)


def test_what_is_slow_or_never_changes_its_speed_is_not_observable() -> None:
    slow, even = decided(clip(0.9, (0.6, 0.5))), decided(clip(0.5, (5.0, 0.0)))
    nearly = decided(clip(0.5, (5.0, 0.0), noise=0.01, flow_error_px=0.1))
    reasons = ("nothing moves faster", *2 * ["nearly the same speed"])
    for decision, reason in zip((slow, even, nearly), reasons, strict=True):
        assert not decision["observable"]
        assert not decision["needed"]
        assert reason in decision["why"]


@pytest.mark.parametrize(
    ("change", "needed"),
    [
        ({}, True),
        ({"gain_percent": 0.2}, False),
        ({"gain_sigma_percent": 2.5}, False),
        ({"shutter": 0.15}, False),
        ({"slope_sigma": 0.4}, False),
        ({"speed_agreement": 0.4}, False),
    ],
    ids=["clear", "too little gain", "gain by chance", "smear below a pixel", "blind", "speeds of noise"],
)
def test_the_decision_follows_gain_and_smear_and_what_can_be_seen(change: dict[str, float], needed: bool) -> None:
    clear = {"speed_px": 6.0, "speed_agreement": 0.9, "shutter": 0.5, "shutter_sigma": 0.05, "slope_sigma": 0.1}
    evidence = clear | {"gain_percent": 4.0, "gain_sigma_percent": 0.1} | change
    assert blur_rules.decide_motion_blur(evidence, "auto", None)["needed"] == needed


def test_blur_in_few_tiles_is_no_chance() -> None:
    """A mover fills four of the tiles, and saves what its blur predicts; the rest shows nothing."""
    sums = np.zeros((3, len(SHUTTERS), TILES[0] * TILES[1]))
    sums[0] = 1.0
    for tile, strength in zip((8, 9, 14, 15), (0.1, 0.8, 4.0, 0.3), strict=True):
        blurred = strength * (SHUTTERS / 0.5) ** 4
        sums[1, :, tile] = np.sqrt(
            blurred * strength
        )  # <a, b> grows with the square of the shutter, <b, b> with its 4th
        sums[2, :, tile] = blurred
    evidence = judge(sums, None)
    assert evidence["shutter"] == pytest.approx(0.5, abs=0.01)
    assert evidence["gain_percent"] > 5 * evidence["gain_sigma_percent"]
    wrong = sums.copy()
    wrong[1, :, 8] *= -1  # what a mover in front of another would do
    wrong[1, :, 9] *= -1
    found = judge(wrong, 0.5)
    assert found["gain_percent"] + found["expected_percent"] < blur_rules.MIN_SIGMAS * found["gain_sigma_percent"]


def test_weak_blur_is_told_from_chance_more_often_than_chance_from_blur() -> None:
    """<a, b> scatters by a quarter of <b, b>, in all tiles alike: about zero without blur, about <b, b> with it."""
    random, n = np.random.default_rng(0), TILES[0] * TILES[1]
    strength = random.exponential(size=n)
    sigma = 0.25 * strength.sum() / n**0.5

    def found(blur: float) -> float:
        decisions = []
        for _ in range(200):
            sums = np.ones((3, len(SHUTTERS), n)) * (100 * strength.mean())
            sums[2] = strength * (SHUTTERS[:, None] / 0.5) ** 4
            sums[1] = (blur * strength + sigma * random.standard_normal(n)) * (SHUTTERS[:, None] / 0.5) ** 2
            evidence = {"speed_px": 6.0, "speed_agreement": 1.0, **judge(sums, 0.5)}
            decisions.append(blur_rules.decide_motion_blur(evidence, "auto", 0.5)["needed"])
        return float(np.mean(decisions))

    assert found(0.0) < 0.01
    assert found(1.0) > 0.75  # 0.5 where the gain itself had to be two standard errors above zero


def test_a_given_shutter_is_judged_and_used() -> None:
    assert decided(clip(0.5), given=0.4)["shutter"] == 0.4
    assert not decided(clip(0.0), given=0.4)["needed"]


def test_the_user_has_blur_where_none_is_observable() -> None:
    nothing = {"speed_px": 0.0}
    assert blur_rules.decide_motion_blur(nothing, "yes", 0.3)["shutter"] == 0.3
    assert blur_rules.decide_motion_blur(nothing, "yes", None)["shutter"] == blur_rules.USUAL_SHUTTER
    assert blur_rules.decide_motion_blur(nothing, "no", 0.3)["shutter"] is None


def test_the_threshold_on_record_is_the_one_that_decides() -> None:
    """A gain of 0.5 +- 0.4 % is above the least gain, and chance all the same, unless it would be -0.9 % by chance."""
    sure = {"speed_px": 6.0, "shutter": 0.5, "shutter_sigma": 0.1, "slope_sigma": 0.1, "speed_agreement": 1.0}
    for sigma, expected, needed in ((0.1, 0.1, True), (0.4, 0.5, False), (0.4, 0.9, True)):
        gain = {"gain_percent": 0.5, "gain_sigma_percent": sigma, "expected_percent": expected}
        found = blur_rules.decide_motion_blur(sure | gain, "auto", None)
        assert found["needed"] == needed == (found["statistic"] >= found["threshold"])
