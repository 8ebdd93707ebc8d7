"""Hard cases of true cameras: a world whose origin is far away."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, make_scene, observe

from stages.ba import initialise
from stages.shared import lie


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A camera that turns as it moves, in a room at rest."""
    return make_scene(T=6)


@pytest.mark.parametrize("displacement", [50.0, 500.0])
def test_depth_under_true_poses_does_not_depend_on_the_origin_of_the_world(scene: Scene, displacement: float) -> None:
    """Translations of cam_from_world then jump as the camera turns: its centres alone say how far it moves."""
    graph = observe(scene)
    moved = scene.cam_from_world @ lie.from_parts(np.eye(3), displacement * np.array([0.6, -0.48, 0.64]))
    near, far = (initialise.initial_state(graph, poses, scene.focal_px) for poses in (scene.cam_from_world, moved))
    assert_allclose(far.inverse_depth, near.inverse_depth, rtol=1e-6)
    truth = graph.resample(1 / scene.depth, 1)
    errors = far.inverse_depth / truth
    assert np.percentile(np.abs(errors / np.median(errors) - 1), 90) < 0.05
