"""Which movers bend: each instance against the flow that rigid motion with free depth could have."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import body
from square_inputs import observe

from stages.scene import bending, geometry, rigid_motion, rules
from stages.scene.bending import Bending
from stages.scene.rigid_motion import Patch
from stages.scene.weigh import Bought


def saved_px(patch: Patch) -> float:
    """Root mean square error that bending saves."""
    stiff, bent = (float(np.square(error).mean()) for error in bending.held_out_errors(patch))
    return float(np.sign(stiff - bent) * abs(stiff - bent) ** 0.5)


def test_a_plane_is_fitted_whatever_the_outliers() -> None:
    uv = np.argwhere(np.ones((24, 32), bool))[:, ::-1]
    x, y = (uv - uv.mean(axis=0)).T / 16
    plane = np.stack(
        [1 + 0.3 * x - 0.2 * y + 0.1 * x * x + 0.05 * x * y, 0.5 * x + 0.1 * x * y + 0.05 * y * y], axis=-1
    )
    assert np.square(geometry.plane_errors(uv, plane)).mean() ** 0.5 < 0.01
    outliers = plane.copy()
    outliers[:60] += 8.0
    assert np.median(np.abs(geometry.plane_errors(uv, outliers))) < 0.02  # least squares leaves 1.4


def test_rigid_motion_with_free_depth_explains_a_deep_body() -> None:
    patch = body(noise_px=0.0)
    left = rigid_motion.residuals(patch, rigid_motion.fit(patch))
    assert np.abs(left).max() < 0.01
    plane = geometry.plane_errors(patch.uv, patch.flow[-1])
    assert np.square(plane).mean() ** 0.5 > 0.3  # a plane does not


def test_bending_is_what_rigid_motion_does_not_predict() -> None:
    assert saved_px(body()) < 0.02
    assert saved_px(body(strain=0.2)) > 3 * rules.MIN_BENDING_PX


def test_noise_is_not_predicted() -> None:
    stiff, bent = bending.held_out_errors(body(noise_px=0.3))
    assert np.square(stiff).mean() < np.square(bent).mean()
    assert np.square(stiff).mean() ** 0.5 == pytest.approx(0.3, rel=0.2)  # of points it was not fitted to


def labelled(seen_flow: np.ndarray, dynamic: np.ndarray, instances: np.ndarray) -> dict[int, Bending]:
    return bending.bending_evidence(replace(observe(), dynamic=dynamic, instances=instances, flow=seen_flow))


def test_a_sliding_square_is_rigid() -> None:
    decision = rules.decide_non_rigid(bending.bending_evidence(observe()), "auto")
    assert not decision["needed"]
    assert decision["arap_weight"] == rules.RIGID_ARAP
    assert [(n, of["label"]) for n, of in decision["instances"].items()] == [("1", "rigid")]


def test_each_instance_has_a_label_of_its_own() -> None:
    """Beside the sliding square, a second mover whose flow is a wave; the one that bends decides."""
    seen = observe()
    dynamic, instances, flow = seen.dynamic.copy(), seen.instances.copy(), seen.flow.copy()
    dynamic[:, 46:62, 5:35] = True
    instances[:, 46:62, 5:35] = 2
    wave = np.sin(0.2 * np.arange(30)) * np.cos(0.3 * np.arange(16))[:, None]
    flow[:, 46:62, 5:35] += np.stack([wave, -wave[::-1]], axis=-1) * seen.offsets[:, None, None, None]
    flow += 0.05 * np.random.default_rng(0).standard_normal(flow.shape).astype(np.float32)
    decision = rules.decide_non_rigid(labelled(flow, dynamic, instances), "auto")
    assert {n: of["label"] for n, of in decision["instances"].items()} == {"1": "rigid", "2": "bending"}
    assert decision["needed"]
    assert decision["statistic"] == decision["instances"]["2"]["bending_px"]


def test_touching_instances_are_apart() -> None:
    """Two rigid squares side by side that go different ways."""
    seen = observe()
    dynamic, instances, flow = np.zeros_like(seen.dynamic), np.zeros_like(seen.instances), seen.flow.copy()
    for number, columns, way in ((1, slice(5, 22), (3, 0)), (2, slice(22, 39), (-3, 2))):
        dynamic[:, 44:62, columns] = True
        instances[:, 44:62, columns] = number
        flow[:, 44:62, columns] = way
    labels = labelled(flow, dynamic, instances)
    assert {n: abs(of.bought.size) < 1e-2 for n, of in labels.items()} == {1: True, 2: True}


def test_what_rolls_is_judged_whatever_the_confidence_of_its_flow() -> None:
    """Flow that varies within a few pixels has a low confidence; where it leads back to its pixel it is right."""
    seen = observe()
    doubted = replace(seen, confidence=np.where(seen.dynamic[seen.edges[:, 0]], 0.05, 1.0).astype(np.float32))
    sure, found = (bending.bending_evidence(of)[1].bought for of in (seen, doubted))
    assert found == sure
    assert found.samples > 0


@pytest.mark.parametrize("wrong", ["leads elsewhere", "is not known"])
def test_flow_that_cannot_be_trusted_is_not_judged(wrong: str) -> None:
    seen = observe()
    ahead = (seen.offsets > 0)[:, None, None]
    if wrong == "leads elsewhere":
        seen = replace(seen, flow=seen.flow + 2 * bending.BACK_PX * ahead[..., None].astype(np.float32))
    else:
        seen = replace(seen, confidence=np.zeros_like(seen.confidence))
    assert all(of.bought.samples == 0 for of in bending.bending_evidence(seen).values())


def test_what_static_patches_show_too_is_no_bending() -> None:
    """A flow that is as wrong, in the same way, on the wall and on the square: a lens, or a rolling shutter."""
    seen = observe()
    v, u = np.mgrid[: seen.flow.shape[1], : seen.flow.shape[2]]
    wave = (0.4 * np.sin(0.35 * u + 0.2 * v)).astype(np.float32)
    flow = seen.flow + np.stack([wave, wave[::-1]], axis=-1) * seen.offsets[:, None, None, None]
    found = labelled(flow, seen.dynamic, seen.instances)[1]
    assert found.bought.size > rules.MIN_BENDING_PX
    assert not rules.decide_non_rigid({1: found}, "auto")["needed"]
    assert rules.decide_non_rigid({1: found._replace(static_px=0.0)}, "auto")["needed"]


def test_labels_are_of_the_instances_alone() -> None:
    bent, stiff = (Bending(Bought(px**2, 0.0, px**2, 9), 0.0) for px in (1.0, 0.05))
    labels = rules.decide_non_rigid({1: bent, 2: stiff}, "no")["instances"]
    assert [labels[n]["label"] for n in "12"] == ["bending", "rigid"]


def test_a_large_rigid_mover_does_not_hide_a_small_one_that_bends() -> None:
    large = Bending(Bought(0.05**2, 1e-5, 0.1, 20_000), 0.0)
    small = Bending(Bought(0.2**2, 1e-4, 0.1, 1000), 0.0)
    decision = rules.decide_non_rigid({1: large, 2: small}, "auto")
    assert decision["needed"]
    assert decision["instances"]["1"]["label"] == "rigid"
    assert decision["statistic"] == pytest.approx(0.2)


def test_a_mover_of_thin_legs_far_apart_is_measured_or_left_out() -> None:
    """Once the border is taken off, a bar on two legs is two columns of pixels, as far apart as a block is wide."""
    dynamic = np.zeros_like(observe().dynamic)
    dynamic[:, 10:62, 5:10] = dynamic[:, 10:62, 45:50] = True
    dynamic[:, 10:13, 5:50] = True
    found = bending.bending_evidence(observe(dynamic=dynamic))
    assert all(np.isfinite([of.bought.saved, of.static_px or 0.0]).all() for of in found.values())


def test_a_mover_that_no_static_patch_is_compared_with_says_so() -> None:
    seen = observe()
    everything = bending.bending_evidence(observe(dynamic=np.ones_like(seen.dynamic)))
    decision = rules.decide_non_rigid(everything, "auto")
    assert decision["instances"]["1"]["static_patches_px"] is None
    assert "no such static patch" in decision["why"]
