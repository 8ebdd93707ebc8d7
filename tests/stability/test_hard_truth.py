"""Hard cases of true cameras: a world whose origin is far away, and cameras that are not one for all frames."""

from pathlib import Path

import numpy as np
import pytest
from ba_files import outputs, write_inputs
from numpy.testing import assert_allclose
from synthetic import Scene, flow_arrays, make_scene, observe

from stages.ba import initialise
from stages.ba.__main__ import main
from stages.ba.options import BAOptions
from stages.shared import lie, sintel
from stages.shared.artifacts import write_json
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence, sequence_to_json


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


@pytest.mark.parametrize("option", ["intrinsics", "poses_from"])
@pytest.mark.parametrize(("row", "column"), [(0, 0), (1, 1), (0, 2), (1, 2), (0, 1)])
def test_a_true_camera_that_is_not_one_for_all_frames_is_refused(
    scene: Scene, row: int, column: int, option: str, tmp_path: Path
) -> None:
    """It zooms, its pixels change their shape, or its centre wanders: what frame 1 has would stand for all."""
    files = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic)
    clip = tmp_path / "training" / "final" / "clip"
    clip.parent.mkdir(parents=True)
    (tmp_path / "clip").rename(clip)
    for k, pose in enumerate(scene.cam_from_world):
        K = scene.K.copy()
        K[row, column] += 0.01 * scene.focal_px * k
        path = tmp_path / "training" / "camdata_left" / "clip" / f"frame_{k + 1:04d}.cam"
        path.parent.mkdir(parents=True, exist_ok=True)
        sintel.write_cam(path, K, pose[:3])
    write_json(files["sequence"], sequence_to_json(check_sequence("clip", clip)))
    with pytest.raises(InputError, match=r"frame_0002\.cam: expected fx 86\.4, fy 86\.4 px.*found fx .*; it cannot"):
        main(**files, **outputs(tmp_path / "out"), options=BAOptions.model_validate({option: "truth"}))
    assert not list((tmp_path / "out").glob("*"))
