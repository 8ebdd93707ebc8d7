"""docs/conventions.md: its lines of code run, and give what the other programs call a camera."""

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pycolmap
import pytest
from conftest import REPO
from PIL import Image
from scipy.spatial.transform import Rotation

from stages.export import axes
from stages.export.options import Format
from stages.shared import lie
from stages.shared.cameras import intrinsics, project

DOCUMENT = REPO / "docs/conventions.md"
LINES = re.findall(r"^```python\n(.*?)^```", DOCUMENT.read_text(), re.MULTILINE | re.DOTALL)
RNG = np.random.default_rng(3)
K = intrinsics(80.0, 85.0, 47.5, 29.0)
CAM_FROM_WORLD = lie.from_parts(lie.exp_so3(np.array([0.3, -0.5, 0.9])), np.array([0.2, -0.4, 1.5]))
POINTS = RNG.uniform([-1, -1, 2], [1, 1, 5], (40, 3)) @ CAM_FROM_WORLD[:3, :3] + lie.inverse(CAM_FROM_WORLD)[:3, 3]
PIXELS = project(POINTS, CAM_FROM_WORLD, K)[0]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """All names after the lines of the document, in its order, with the second of three cameras as frame k."""
    folder = tmp_path_factory.mktemp("conventions")
    poses = np.stack([np.eye(4), CAM_FROM_WORLD, np.eye(4)])
    np.savez(folder / "scene.npz", cam_from_world=poses, Ks=np.stack([np.eye(3), K, np.eye(3)]))
    names: dict[str, Any] = {"k": 1}
    for line in LINES:
        exec(line.replace("scene.npz", str(folder / "scene.npz")), names)
    return names


def camera_coordinates(world_from_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [n, 3] in the axes of a camera, x y z as rows [3, n]."""
    return np.asarray((points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]).T


def test_every_line_is_one_that_these_tests_know() -> None:
    given = [re.findall(r"^(.*?) = ", line, re.MULTILINE)[-1] for line in LINES]
    assert given == [
        "cam_from_world, K",
        "qvec, tvec, K_colmap",
        "matrix_world",
        "matrix_world_z_up",
        "transform_matrix, fl_x, fl_y, cx, cy",
        "position, orientation_xyzw",
        "world_from_body",
    ]


def test_colmap(found: dict[str, Any]) -> None:
    rotation = pycolmap.Rotation3d(np.roll(found["qvec"], -1))  # xyzw
    placed = pycolmap.Rigid3d(rotation, found["tvec"])
    fx, fy, cx, cy = found["K_colmap"][[0, 1, 0, 1], [0, 1, 2, 2]]
    camera = pycolmap.Camera(model="PINHOLE", width=96, height=64, params=[fx, fy, cx, cy])
    pixels = np.array([camera.img_from_cam(placed * point) for point in POINTS])
    assert np.allclose(pixels, PIXELS + 0.5)


@pytest.mark.parametrize("name", ["matrix_world", "matrix_world_z_up", "transform_matrix"])
def test_opengl_blender_and_nerfstudio(found: dict[str, Any], name: str) -> None:
    points = POINTS if name != "matrix_world_z_up" else np.stack([POINTS[:, 0], POINTS[:, 2], -POINTS[:, 1]], axis=-1)
    assert np.linalg.det(found[name][:3, :3]) == pytest.approx(1)
    x, y, z = camera_coordinates(found[name], points)
    assert (z < 0).all()
    pixels = np.stack([found["fl_x"] * x / -z + found["cx"], found["cy"] - found["fl_y"] * y / -z], axis=-1)
    assert np.allclose(pixels, PIXELS + 0.5)


def test_ros(found: dict[str, Any]) -> None:
    turn = Rotation.from_quat(found["orientation_xyzw"]).as_matrix()
    x, y, z = ((POINTS - found["position"]) @ turn).T
    assert np.allclose(np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], axis=-1), PIXELS)
    forward, left, up = camera_coordinates(found["world_from_body"], POINTS)
    assert np.allclose([-left, -up, forward], [x, y, z])


def test_the_picture_shows_these_axes(found: dict[str, Any], tmp_path: Path) -> None:
    """And it is drawn by the command that the document names."""
    ours, opengl, body = axes.CAMERAS.values()
    assert np.array_equal(ours, np.eye(3))
    assert np.allclose(CAM_FROM_WORLD[:3, :3] @ found["matrix_world"][:3, :3], opengl)
    assert np.allclose(CAM_FROM_WORLD[:3, :3] @ found["world_from_body"][:3, :3], body)
    axes.main(tmp_path / "drawn.png")
    with Image.open(tmp_path / "drawn.png") as drawn, Image.open(REPO / "docs/conventions.png") as kept:
        assert drawn.size == kept.size
    assert (REPO / "docs/conventions.png").stat().st_size < 40_000
    assert "(conventions.png)" in DOCUMENT.read_text()
    assert "python -m stages.export.axes --output docs/conventions.png" in DOCUMENT.read_text()


def test_the_document_explains_every_format() -> None:
    explained = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`[^|]*) \|", DOCUMENT.read_text(), re.MULTILINE))))
    assert set(get_args(Format)) <= explained
