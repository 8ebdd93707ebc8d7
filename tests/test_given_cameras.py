"""Cameras that a user gives: what other programs and our export write is read back, and what is wrong is named."""

import json
from dataclasses import replace
from pathlib import Path

import export_clip as truth
import numpy as np
import pycolmap
import pytest

from stages.ba.options import BAOptions
from stages.export.__main__ import main as export
from stages.export.options import ExportOptions
from stages.given.cameras_files import read_intrinsics, read_poses
from stages.given.intrinsics import parse
from stages.shared.cameras import centred_intrinsics, intrinsics, make_cameras, scale_intrinsics, write_tum
from stages.shared.colmap_records import MODELS
from stages.shared.errors import InputError
from stages.shared.options import to_flags, validate
from stages.shared.sequences import Sequence

FRAMES = Sequence(
    "wall",
    [Path(f"frame_{k + 1:04d}.png") for k in range(truth.T)],
    list(range(1, truth.T + 1)),
    truth.W,
    truth.H,
)
NAMES = [path.name for path in FRAMES.frames]


def tum(path: Path, stamps: list[float], poses: np.ndarray = truth.CAM_FROM_WORLD) -> Path:
    """A trajectory of poses [T, 4, 4] with these time stamps."""
    write_tum(path, make_cameras(poses, truth.K, np.arange(len(poses))), stamps)
    return path


def colmap_model(folder: Path, model: str, parameters: list[list[float]], size: tuple[int, int] = (96, 64)) -> Path:
    """A model by pycolmap in text and binary with one camera for each list of parameters, the images in reverse."""
    rebuilt = pycolmap.Reconstruction()
    for k, values in enumerate(parameters):
        camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=values, camera_id=k + 7)
        rebuilt.add_camera_with_trivial_rig(camera)
    for k in reversed(range(truth.T)):
        pose = pycolmap.Rigid3d(truth.CAM_FROM_WORLD[k, :3])
        image = pycolmap.Image(name=f"left/{NAMES[k]}", camera_id=k % len(parameters) + 7, image_id=90 - k)
        rebuilt.add_image_with_trivial_frame(image, pose)
    for kind, write in {"text": rebuilt.write_text, "binary": rebuilt.write_binary}.items():
        (folder / kind).mkdir(parents=True)
        write(folder / kind)
    return folder


def test_what_we_export_is_read_back(tmp_path: Path) -> None:
    """COLMAP in binary and in text, nerfstudio and TUM, with an off-centre principal point and fx != fy."""
    files = truth.write_clip(tmp_path)
    options = ExportOptions(formats=("colmap", "nerfstudio"))
    export(**files, output=tmp_path / "export", options=options)
    for name in ("sparse/0", "sparse_text", "transforms.json"):
        poses, Ks = read_poses(str(tmp_path / "export" / name), FRAMES)
        assert np.allclose(poses, truth.CAM_FROM_WORLD, atol=1e-12)
        assert Ks is not None
        assert np.allclose(Ks, truth.K, atol=1e-9)
    poses, Ks = read_poses(str(tum(tmp_path / "path.tum", FRAMES.stamps)), FRAMES)
    assert np.allclose(poses, truth.CAM_FROM_WORLD, atol=1e-12)
    assert Ks is None
    assert np.allclose(read_intrinsics(str(tmp_path / "export/sparse_text/cameras.txt"), FRAMES), truth.K, atol=1e-9)


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_models_of_pycolmap(tmp_path: Path, kind: str) -> None:
    """A camera for every other image, of images at half the size, whose names hold a folder."""
    folder = colmap_model(tmp_path, "SIMPLE_PINHOLE", [[40.0, 20.0, 18.0], [44.0, 20.0, 18.0]], (48, 32))
    poses, Ks = read_poses(str(folder / kind), FRAMES)
    assert np.allclose(poses, truth.CAM_FROM_WORLD, atol=1e-12)
    assert Ks is not None
    small = intrinsics([40.0, 44.0], [40.0, 44.0], 19.5, 17.5)
    assert np.allclose(Ks[:2], scale_intrinsics(small, 2), atol=1e-9)
    assert np.allclose(Ks[2:4], Ks[:2])
    with pytest.raises(InputError, match="expected one camera for all frames, found 2 that differ; name the whole"):
        read_intrinsics(str(folder / kind / ("cameras.txt" if kind == "text" else "cameras.bin")), FRAMES)


def test_camera_models_are_those_of_pycolmap() -> None:
    for number, model in MODELS.items():
        theirs = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(number), 100.0, 64, 48)
        assert (theirs.model.name, len(theirs.params)) == (model.name, model.parameters)
        assert len(theirs.focal_length_idxs()) == model.focals


def test_a_distortion_is_refused_by_the_name_of_its_model_unless_it_is_zero(tmp_path: Path) -> None:
    folder = colmap_model(tmp_path / "zero", "SIMPLE_RADIAL", [[95.0, 45.5, 33.5, 0.0]])
    assert np.allclose(read_intrinsics(str(folder / "text/cameras.txt"), FRAMES), intrinsics(95, 95, 45, 33))
    for model, parameters in {"SIMPLE_RADIAL": [0.01], "OPENCV_FISHEYE": [95.0, 0.0, 0.0, 0.0, 0.0]}.items():
        values = [95.0, *parameters[:1], 45.5, 33.5, *parameters[1:]] if model[0] == "O" else [95.0, 45.5, 33.5, 0.01]
        folder = colmap_model(tmp_path / model, model, [values])
        for kind in ("text", "binary"):
            with pytest.raises(InputError, match=f"without distortion.*found model {model}; undistort the frames"):
                read_poses(str(folder / kind), FRAMES)


@pytest.mark.parametrize(
    ("given", "meant", "K"),
    [
        (80, "80", centred_intrinsics(80, 96, 64)),
        ("80.5 px", "80.5 px", centred_intrinsics(80.5, 96, 64)),
        ("26 mm / 36 mm", "26 mm / 36 mm", centred_intrinsics(26 / 36 * 96, 96, 64)),
        ({"focal_mm": 26, "sensor_width_mm": 36}, "26 mm / 36 mm", centred_intrinsics(26 / 36 * 96, 96, 64)),
        ([95, 90, 45, 33], "95, 90, 45, 33", truth.K),
        ({"fx": 95, "fy": 90, "cx": 45, "cy": 33}, "95, 90, 45, 33", truth.K),
    ],
)
def test_intrinsics_in_the_words_of_a_config_file(given: object, meant: str, K: np.ndarray) -> None:
    options = BAOptions(intrinsics=given)  # type: ignore[arg-type]
    assert options.intrinsics == meant
    assert np.allclose(read_intrinsics(options.intrinsics, FRAMES), K)
    assert f"--intrinsics '{meant}'" in to_flags(options) or f"--intrinsics {meant}" in to_flags(options)


def test_a_sensor_is_as_wide_as_the_longer_side_of_upright_frames() -> None:
    upright = replace(FRAMES, width=64, height=96)
    assert read_intrinsics("26 mm / 36 mm", upright)[0, 0] == pytest.approx(26 / 36 * 96)


@pytest.mark.parametrize("wrong", ["estimat", True, "26 mm", [95, 90, 45], {"fx": 95}, -80, "0 mm / 36 mm", "a.json"])
def test_other_words_for_intrinsics_are_refused(wrong: object) -> None:
    with pytest.raises(InputError, match="intrinsics: expected"):
        validate(BAOptions, {"intrinsics": wrong}, "config.yaml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("3", "focal length of 19 to 1920 px, found 3 px"),
        ("5000", "focal length of 19 to 1920 px, found 5000 px; numbers are in px of the frames as they are used"),
        ("950, 900, 450, 330", r"principal point within the frames, 96 x 64 px, found \(450, 330\).*max_side"),
    ],
)
def test_numbers_of_other_frames_are_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_intrinsics(text, FRAMES)


def test_cameras_of_another_shape_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("# comment\n1 PINHOLE 4000 3000 3900 3900 2000 1500\n")
    with pytest.raises(InputError, match=r"shaped like the frames, 96 x 64, found 4000 x 3000"):
        read_intrinsics(str(path), FRAMES)


def test_poses_are_matched_by_time_by_number_and_by_order(tmp_path: Path) -> None:
    times = [0.04 * k + 2.0 for k in range(truth.T)]
    clip = replace(FRAMES, times_s=times)
    denser = [time + part for time in times for part in (0.0, 0.02)]
    between = np.repeat(truth.CAM_FROM_WORLD, 2, axis=0)
    between[1::2] = np.eye(4)
    dense = tum(tmp_path / "dense.tum", denser, between)
    assert np.allclose(read_poses(str(dense), clip)[0], truth.CAM_FROM_WORLD)
    epochs = tum(tmp_path / "epochs.tum", [1305031102.17 + time for time in times])
    assert np.allclose(read_poses(str(epochs), clip)[0], truth.CAM_FROM_WORLD)
    with pytest.raises(
        InputError, match=rf"each of the 8 frames, found none for 8 of them, the first {NAMES[0]}, among 16"
    ):
        read_poses(str(tum(tmp_path / "far.tum", [time + 90 for time in denser], between)), clip)


def write_transforms(path: Path, change: dict, **top: object) -> Path:
    """A transforms.json of the clip whose first frame has other values, by numbers alone in its file names."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = np.linalg.inv(truth.CAM_FROM_WORLD) @ flip
    frames = [{"file_path": f"./images/{k + 1}", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)]
    frames[0] |= change
    path.write_text(json.dumps({"w": 96, "h": 64, "camera_angle_x": 2 * np.arctan(48 / 95), **top, "frames": frames}))
    return path


def test_transforms_of_blender(tmp_path: Path) -> None:
    poses, Ks = read_poses(str(write_transforms(tmp_path / "transforms.json", {})), FRAMES)
    assert np.allclose(poses, truth.CAM_FROM_WORLD)
    assert Ks is not None
    assert np.allclose(Ks, centred_intrinsics(95, 96, 64))


@pytest.mark.parametrize(
    ("change", "top", "said"),
    [
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, {}, r"rotation matrix for \./images/1, found one whose rows"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, {}, "found a reflection: its axes are left-handed"),
        ({"transform_matrix": [[1, 2]]}, {}, "expected frames with file_path and transform_matrix|shape"),
        ({"file_path": "images/77"}, {}, r"found none for 1 of them, the first frame_0001\.png, among 8 images"),
        ({"fl_x": 95.0, "cx": 60.0}, {}, "expected one principal point and one ratio fy / fx for all frames, found fx"),
        ({}, {"k1": 0.1}, "found model OPENCV; undistort"),
        ({}, {"camera_model": "EQUIRECTANGULAR"}, "found model EQUIRECTANGULAR; undistort"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, {}, "finite numbers in every transform_matrix"),
        ({"fl_x": None}, {}, "expected numbers fl_x, fl_y, cx, cy, w, h, found another structure"),
        ({"fl_x": np.nan}, {}, "expected finite intrinsics, found nan, nan, 48, 32, 0"),
        ({}, {"w": 0}, "expected the size of the images in px, found 0 x 64"),
        ({}, {"w": 128}, "shaped like the frames, 96 x 64, found 128 x 64"),
    ],
)
def test_wrong_transforms_are_named(tmp_path: Path, change: dict, top: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_poses(str(write_transforms(tmp_path / "transforms.json", change, **top)), FRAMES)


def test_the_lenses_of_a_file_do_not_matter_where_others_are_given(tmp_path: Path) -> None:
    path = write_transforms(tmp_path / "transforms.json", {"fl_x": 95.0, "cx": 60.0})
    poses, Ks = read_poses(str(path), FRAMES, lenses=False)
    assert np.allclose(poses, truth.CAM_FROM_WORLD)
    assert Ks is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1 0 0 0 0 0 1", "expected 8 numbers in line 3: timestamp tx ty tz qx qy qz qw, found 7"),
        ("a b c d e f g h", "expected numbers in line 3.*found 'a b c d"),
        ("1 0 0 0 0 0 0 2", "expected a quaternion of length 1 for line 3, found length 2"),
        ("1 nan 0 0 0 0 0 1", "expected finite numbers for line 3"),
        ("nan 0 0 0 0 0 0 1", "expected a finite time stamp in line 3, found nan"),
        ("2 0 0 0 0 0 0 1", "expected time stamps that differ, found 2 in line 2 and line 3"),
    ],
)
def test_wrong_lines_of_a_trajectory_are_named(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "path.tum").write_text(f"# stamp x y z\n2 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=said):
        read_poses(str(tmp_path / "path.tum"), FRAMES)


def test_a_byte_order_mark_is_no_word(tmp_path: Path) -> None:
    """Editors on Windows write it in front of a text."""
    trajectory = tum(tmp_path / "path.tum", FRAMES.stamps)
    transforms = write_transforms(tmp_path / "transforms.json", {})
    model = colmap_model(tmp_path / "colmap", "PINHOLE", [[95.0, 90.0, 45.5, 33.5]]) / "text"
    for path in (trajectory, transforms, model / "cameras.txt", model / "images.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    for given in (trajectory, transforms, model):
        assert np.allclose(read_poses(str(given), FRAMES)[0], truth.CAM_FROM_WORLD)


def test_models_that_are_incomplete_are_named(tmp_path: Path) -> None:
    folder = colmap_model(tmp_path, "PINHOLE", [[95.0, 90.0, 45.5, 33.5]])
    images = folder / "binary/images.bin"
    images.write_bytes(images.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"images\.bin: expected a complete file"):
        read_poses(str(folder / "binary"), FRAMES)
    (folder / "text/cameras.txt").write_text("1 PINHOLE 96 64 95 90 45.5\n")
    with pytest.raises(InputError, match=r"cameras\.txt: expected 4 parameters of PINHOLE in line 1, found 3"):
        read_poses(str(folder / "text"), FRAMES)
    with pytest.raises(InputError, match=r"cameras and images of a COLMAP model.*found none"):
        read_poses(str(folder), FRAMES)
    with pytest.raises(InputError, match="expected an existing file or folder, found nothing there"):
        read_poses(str(folder / "{sequence}"), FRAMES)


def test_a_path_names_each_sequence(tmp_path: Path) -> None:
    path = tum(tmp_path / "wall.tum", FRAMES.stamps)
    assert parse("lenses/{sequence}.txt").path == "lenses/{sequence}.txt"
    assert np.allclose(read_poses(str(path).replace("wall", "{sequence}"), FRAMES)[0], truth.CAM_FROM_WORLD)
