"""Which movers bend: each instance against the flow that a rigid plane could have."""

from dataclasses import replace

import numpy as np
from square_inputs import observe

from stages.scene import geometry, rules


def test_planar_residual_is_zero_for_a_rigid_plane_only() -> None:
    uv = np.argwhere(np.ones((20, 30), bool))[:, ::-1]
    x, y = (uv - uv.mean(axis=0)).T / 15
    plane = np.stack(
        [1 + 0.3 * x - 0.2 * y + 0.1 * x * x + 0.05 * x * y, 0.5 * x + 0.1 * x * y + 0.05 * y * y], axis=-1
    )
    assert np.median(geometry.planar_residual(uv, plane)) < 1e-6
    outliers = plane.copy()
    outliers[:60] += 8.0
    assert np.median(geometry.planar_residual(uv, outliers)) < 0.02  # least squares leaves 1.4
    curved = plane + np.stack([np.zeros(len(uv)), np.sin(9 * x)], axis=-1)
    assert np.median(geometry.planar_residual(uv, curved)) > 0.3


def test_a_sliding_square_is_rigid() -> None:
    seen = observe()
    regions = geometry.moving_regions(seen)
    bending = geometry.bending_evidence(seen, regions), geometry.bending_of_instances(regions)
    decision = rules.decide_non_rigid(*bending, "auto")
    assert not decision["needed"]
    assert decision["points"] == rules.RIGID_POINTS
    assert decision["arap_weight"] == rules.RIGID_ARAP
    assert [(n, of["label"]) for n, of in decision["instances"].items()] == [("1", "rigid")]


def test_each_instance_has_a_label_of_its_own() -> None:
    """Beside the sliding square, a second mover whose flow is a wave."""
    seen = observe()
    dynamic, instances, flow = seen.dynamic.copy(), seen.instances.copy(), seen.flow.copy()
    dynamic[:, 50:60, 5:30] = True
    instances[:, 50:60, 5:30] = 2
    flow[:, 50:60, 5:30, 1] += 2 * np.sin(1.3 * np.arange(25))
    waving = replace(seen, dynamic=dynamic, instances=instances, flow=flow)
    labels = geometry.bending_of_instances(geometry.moving_regions(waving))
    assert labels[1]["bending_px"] < rules.MIN_BENDING_PX < labels[2]["bending_px"]


def test_touching_instances_are_apart() -> None:
    """Two rigid squares side by side that go different ways."""
    seen = observe()
    dynamic, instances, flow = np.zeros_like(seen.dynamic), np.zeros_like(seen.instances), seen.flow.copy()
    for number, columns, way in ((1, slice(5, 17), (3, 0)), (2, slice(17, 28), (-3, 2))):
        dynamic[:, 50:60, columns] = True
        instances[:, 50:60, columns] = number
        flow[:, 50:60, columns] = way
    regions = geometry.moving_regions(replace(seen, dynamic=dynamic, instances=instances, flow=flow))
    labels = geometry.bending_of_instances(regions)
    assert {n: of["bending_px"] < 1e-6 for n, of in labels.items()} == {1: True, 2: True}


def test_labels_are_of_the_instances_alone() -> None:
    bent, stiff = ({"bending_px": px, "flow_spread_px": 1.0} for px in (1.0, 0.1))
    labels = rules.decide_non_rigid(stiff, {1: bent, 2: stiff}, "no")["instances"]
    assert [labels[n]["label"] for n in "12"] == ["bending", "rigid"]
