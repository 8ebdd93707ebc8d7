"""Which movers bend: each instance against the flow that a rigid plane could have."""

from dataclasses import replace

import numpy as np
from square_inputs import observe

from stages.scene import geometry, rules
from stages.scene.weigh import Bought


def test_bending_is_what_a_rigid_plane_does_not_predict() -> None:
    uv = np.argwhere(np.ones((24, 32), bool))[:, ::-1]
    x, y = (uv - uv.mean(axis=0)).T / 16
    plane = np.stack(
        [1 + 0.3 * x - 0.2 * y + 0.1 * x * x + 0.05 * x * y, 0.5 * x + 0.1 * x * y + 0.05 * y * y], axis=-1
    )
    rms = [float(np.sqrt(np.square(error).mean())) for error in geometry.held_out_errors(uv, plane)]
    assert max(rms) < 0.01
    outliers = plane.copy()
    outliers[:60] += 8.0
    assert np.median(np.abs(geometry.held_out_errors(uv, outliers)[0])) < 0.02  # least squares leaves 1.4
    curved = plane + np.stack([np.zeros(len(uv)), np.sin(3 * x)], axis=-1)
    stiff, bent = (float(np.abs(error).mean()) for error in geometry.held_out_errors(uv, curved))
    assert stiff > 0.1
    assert bent < 0.3 * stiff
    noise = np.random.default_rng(0).standard_normal(plane.shape)
    stiff, bent = (float(np.square(error).mean()) for error in geometry.held_out_errors(uv, plane + 0.3 * noise))
    assert stiff < bent  # noise is not predicted: its residual to a plane alone would be 0.3 px


def test_a_sliding_square_is_rigid() -> None:
    seen = observe()
    regions = geometry.moving_regions(seen)
    bending = geometry.bending_of(regions), float(seen.dynamic.mean()), geometry.bending_of_instances(regions)
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
    flow[:, 50:60, 5:30, 1] += 3 * np.sin(0.4 * np.arange(25))
    flow += 0.05 * np.random.default_rng(0).standard_normal(flow.shape).astype(np.float32)
    waving = replace(seen, dynamic=dynamic, instances=instances, flow=flow)
    labels = geometry.bending_of_instances(geometry.moving_regions(waving))
    assert labels[1][0].size < rules.MIN_BENDING_PX < labels[2][0].size


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
    assert {n: abs(bought.size) < 1e-3 for n, (bought, _) in labels.items()} == {1: True, 2: True}


def test_labels_are_of_the_instances_alone() -> None:
    bent, stiff = ((Bought(px**2, 0.0, px**2, 9), 1.0) for px in (1.0, 0.1))
    labels = rules.decide_non_rigid(stiff, 0.2, {1: bent, 2: stiff}, "no")["instances"]
    assert [labels[n]["label"] for n in "12"] == ["bending", "rigid"]
    small, large = (rules.decide_non_rigid(bent, area, {}, "auto")["needed"] for area in (0.01, 0.2))
    assert not small
    assert large
