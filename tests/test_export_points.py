"""Exported points behind an occluder, and masks that the adjustment did not trust, against exact geometry."""

from pathlib import Path

import export_clip as truth
import numpy as np
import pytest
from PIL import Image

from stages.export import __main__ as export_stage
from stages.export.options import ExportOptions
from stages.export.points import DepthGrid, find_points
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.cameras import intrinsics, make_cameras, pixel_grid, unproject, write_cameras
from stages.shared.errors import InputError

NEAR, FAR = 2.0, 4.0
"""Depths of a strip |x| < HALF, and of the wall behind it, both upright and across the optical axis."""
HALF = 0.3


def visible_depth(uv: np.ndarray, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Depth [...] of the nearest surface at pixels uv [..., 2] of a camera that looks along z."""
    x = unproject(uv, np.full(uv.shape[:-1], NEAR), pose, K)[..., 0]
    return np.where(np.abs(x) < HALF, NEAR, FAR)


def test_no_point_is_observed_where_something_stands_before_it() -> None:
    poses, K = np.tile(np.eye(4), (5, 1, 1)), intrinsics(40.0, 40.0, 31.5, 23.5)
    poses[:, 0, 3] = np.linspace(-0.4, 0.4, 5)
    uv = pixel_grid(48, 64)
    inverse_depth = np.stack([1 / visible_depth(uv, pose, K) for pose in poses]).astype(np.float32)
    usable, colours = np.ones(inverse_depth.shape, bool), np.zeros((*inverse_depth.shape, 3), np.uint8)
    points = find_points(DepthGrid(inverse_depth, usable, colours, 1.0, poses, np.tile(K, (5, 1, 1))))
    assert set(np.round(points.xyz[:, 2], 4)) == {NEAR, FAR}
    for k, pose in enumerate(poses):
        mine = points.frame == k
        shown = visible_depth(np.rint(points.uv[mine]), pose, K)
        assert np.allclose(points.xyz[points.point[mine], 2], shown, rtol=1e-5)
        assert {NEAR, FAR} == set(shown)


def test_masks_that_were_not_trusted_are_exported_empty(tmp_path: Path) -> None:
    inputs = truth.write_clip(tmp_path)
    trusted = np.arange(truth.T) != 3
    cameras = make_cameras(truth.CAM_FROM_WORLD, truth.K, np.arange(1, truth.T + 1), masks_trusted=trusted)
    write_cameras(inputs["poses"], cameras)
    export_stage.main(**inputs, output=tmp_path / "export", options=ExportOptions(formats=("masks", "npz")))
    archive = np.load(tmp_path / "export/scene.npz")
    for k in range(truth.T):
        picture = np.asarray(Image.open(tmp_path / f"export/masks/frame_{k + 1:04d}.png.png"))
        expected = truth.mask(k) & trusted[k]
        assert np.array_equal(picture == 0, expected)
        assert np.array_equal(archive["masks"][k], expected)
        assert np.array_equal(archive["instances"][k] > 0, expected)


def test_poses_and_depth_of_another_sequence_are_refused(tmp_path: Path) -> None:
    inputs, fewer = truth.write_clip(tmp_path), truth.T - 1
    cameras = make_cameras(truth.CAM_FROM_WORLD[:fewer], truth.K, np.arange(1, truth.T))
    write_cameras(tmp_path / "other.parquet", cameras)
    columns = {name: values[1:] for name, values in read_dense(inputs["depth"]).items()}
    write_dense(tmp_path / "other.arrow", columns, {"stride_px": truth.STRIDE})
    for name, other, found in (("poses", "other.parquet", "from 1 on"), ("depth", "other.arrow", "from 2 on")):
        with pytest.raises(InputError, match=f"{other}: expected 8 frames from 1 on, .*, found 7 frames {found}"):
            export_stage.main(
                **inputs | {name: tmp_path / other},
                output=tmp_path / "export",
                options=ExportOptions(formats=("npz",)),
            )
