"""Exports, each read again by programs or readers that know nothing of us: cameras, points, depth, masks, archive."""

import json
import shutil
from pathlib import Path

import cv2
import export_clip as truth
import numpy as np
import pycolmap
import pytest
from PIL import Image

from stages.configuration import config as configuration
from stages.export import __main__ as export_stage
from stages.export.images import write_video
from stages.export.options import ExportOptions
from stages.shared.artifacts import write_json
from stages.shared.cameras import pixel_grid, project
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.options import to_flags, validate
from stages.shared.pace import SECONDS_PER_FRAME
from stages.shared.warp import bilinear

GIVEN = np.random.default_rng(1).uniform([-1, -1, 3], [2, 1, 6], (50, 3))
"""World points in front of all cameras."""


def export(folder: Path, *formats: str, splat_frames: tuple[int, ...] = (2, 3), **inputs: Path) -> Path:
    """The folder with these formats of the clip."""
    inputs = inputs or truth.write_clip(folder)
    options = ExportOptions(formats=formats, splat_frames=splat_frames)  # type: ignore[arg-type]
    export_stage.main(**inputs, output=folder / "export", options=options)
    return folder / "export"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What needs no Gaussians, once."""
    return export(tmp_path_factory.mktemp("export"), "colmap", "nerfstudio", "npz", "depth_png", "masks")


def ours(k: int) -> np.ndarray:
    """Pixels [n, 2] of the given points in frame k, the centre of the first pixel at (0, 0)."""
    return project(GIVEN, truth.CAM_FROM_WORLD[k], truth.K)[0]


@pytest.mark.parametrize("folder", ["sparse/0", "sparse_text"])
def test_colmap_projects_points_where_we_do(exported: Path, folder: str) -> None:
    model = pycolmap.Reconstruction(exported / folder)
    assert model.num_reg_images() == truth.T
    for image in model.images.values():
        k = int(image.name[6:10]) - 1
        pixels = np.array([image.project_point(point) for point in GIVEN])
        assert np.allclose(pixels, ours(k) + 0.5, atol=1e-9)
        assert (exported / "images" / image.name).is_file()
        seen = [point for point in image.points2D if point.has_point3D()]
        there = [image.project_point(model.points3D[point.point3D_id].xyz) for point in seen]
        assert len(seen) == len(image.points2D) > 200
        assert np.allclose(there, [point.xy for point in seen], atol=1e-6)
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    assert model.compute_mean_track_length() > 4


def test_both_files_of_colmap_hold_what_pycolmap_reads(exported: Path) -> None:
    model = pycolmap.Reconstruction(exported / "sparse/0")
    for cameras, images, points in (
        truth.read_binary(exported / "sparse/0"),
        truth.read_text(exported / "sparse_text"),
    ):
        assert cameras == {1: [truth.W, truth.H, 95.0, 90.0, 45.5, 33.5]}
        assert set(images) == set(model.images)
        assert set(points) == set(model.points3D)
        for number, (pose, name, pixels) in images.items():
            theirs = model.images[number]
            quat = theirs.cam_from_world().rotation.quat  # xyzw
            assert np.allclose(pose, [*np.roll(quat, 1), *theirs.cam_from_world().translation, 1])
            assert theirs.name == name
            assert np.allclose(pixels[:, :2], [point.xy for point in theirs.points2D])
            assert pixels[:, 2].tolist() == [point.point3D_id for point in theirs.points2D]
        for number, (values, track) in points.items():
            theirs = model.points3D[number]
            assert np.allclose(values, [*theirs.xyz, *theirs.color, theirs.error])
            assert track == [value for one in theirs.track.elements for value in (one.image_id, one.point2D_idx)]


def test_points_lie_on_the_wall_in_its_colours_and_none_on_the_square(exported: Path) -> None:
    _, images, points = truth.read_binary(exported / "sparse/0")
    values = np.array([values for values, _ in points.values()])
    assert len(values) > 300
    assert np.abs(values[:, 2] - truth.WALL_Z).max() < 1e-5
    assert (values[:, 6] < 0.5).all()
    assert np.abs(truth.colour(values[:, :3]).astype(float) - values[:, 3:6]).mean() < 1
    for _, name, pixels in images.values():
        assert len(pixels) > 200
        nearest = np.floor(pixels[:, :2]).astype(int)
        assert not truth.mask(int(name[6:10]) - 1)[nearest[:, 1], nearest[:, 0]].any()


def test_cameras_that_differ_and_frames_without_a_pose(tmp_path: Path) -> None:
    status = np.full(truth.T, "estimated", object)
    status[2] = "unobserved"
    zoomed = np.stack([truth.K * [[1 + k // 4], [1 + k // 4], [1]] for k in range(truth.T)])
    folder = export(tmp_path, "colmap", "nerfstudio", "npz", **truth.write_clip(tmp_path, status, zoomed))
    cameras, images, _ = truth.read_binary(folder / "sparse/0")
    assert [camera[2] for camera in cameras.values()] == [95.0, 190.0]
    assert [pose[-1] for pose, _, _ in images.values()] == [1, 1, 1, 2, 2, 2, 2]
    assert "frame_0003.png" not in {name for _, name, _ in images.values()}
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert [frame["fl_x"] for frame in frames] == [95.0] * 3 + [190.0] * 4
    assert [round(7 * frame["time"]) for frame in frames] == [0, 1, 3, 4, 5, 6, 7]
    assert np.load(folder / "scene.npz")["has_pose"].tolist() == [k != 2 for k in range(truth.T)]


def test_cameras_of_frames_that_were_undistorted_project_into_the_original_ones(tmp_path: Path) -> None:
    square = truth.K * [[1, 1, 1], [1, 95 / 90, 1], [1, 1, 1]]
    inputs = truth.write_clip(tmp_path, Ks=np.tile(square, (truth.T, 1, 1)))
    names = [f"original_{k}.jpg" for k in range(truth.T)]
    about: dict[str, object] = {"coefficients_px": [-0.2 / 95**2, 0.05 / 95**4], "left": 3, "top": 2}
    write_json(tmp_path / "lens.json", about | {"original": {"width": 102, "height": 68, "frames": names}})
    folder = export(tmp_path, "colmap", **inputs, lens=tmp_path / "lens.json")
    model = pycolmap.Reconstruction(folder / "original")
    assert (model.num_images(), model.num_points3D()) == (truth.T, 0)
    camera = model.cameras[1]
    assert (camera.model.name, camera.width, camera.height) == ("RADIAL", 102, 68)
    assert np.allclose(camera.params, [95, 45 + 3.5, 33 + 2.5, -0.2, 0.05])
    for image in model.images.values():
        k = names.index(image.name)
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        assert np.allclose(pose.matrix(), truth.CAM_FROM_WORLD[k, :3])
    about["coefficients_px"] = None
    write_json(tmp_path / "lens.json", about)
    assert not (export(tmp_path, "colmap", **inputs, lens=tmp_path / "lens.json") / "original").exists()


def test_nerfstudio_finds_points_at_the_same_pixels(exported: Path) -> None:
    """Camera-to-world with x right, y up, z backward; pixel centres at half-integers, as its documentation has it."""
    content = json.loads((exported / "transforms.json").read_text())
    assert (content["w"], content["h"], content["camera_model"]) == (truth.W, truth.H, "OPENCV")
    assert len(content["frames"]) == truth.T
    for k, frame in enumerate(content["frames"]):
        x, y, z = ((GIVEN - np.array(frame["transform_matrix"])[:3, 3]) @ np.array(frame["transform_matrix"])[:3, :3]).T
        pixels = np.stack([content["fl_x"] * x / -z + content["cx"], content["fl_y"] * y / z + content["cy"]], axis=-1)
        assert np.allclose(pixels, ours(k) + 0.5)
        assert all((exported / frame[key]).is_file() for key in ("file_path", "mask_path", "depth_file_path"))


def test_initial_points_have_the_colours_of_the_frames_there(exported: Path) -> None:
    content = json.loads((exported / "transforms.json").read_text())
    head, _, body = (exported / content["ply_file_path"]).read_bytes().partition(b"end_header\n")
    fields = [line.split() for line in head.decode().splitlines() if line.startswith("property")]
    kinds = {"float": "<f4", "uchar": "u1"}
    table = np.frombuffer(body, [(name, kinds[kind]) for _, kind, name in fields])
    xyz = np.stack([table[name] for name in "xyz"], axis=-1).astype(float)
    uv = project(xyz, truth.CAM_FROM_WORLD[0], truth.K)[0]
    nearest = np.rint(uv).astype(int)
    seen = ((nearest >= 0) & (nearest < (truth.W, truth.H))).all(axis=-1)
    seen[seen] &= ~truth.mask(0)[nearest[seen, 1], nearest[seen, 0]]
    image = np.array(Image.open(exported / content["frames"][0]["file_path"]))
    rgb = np.stack([table[name] for name in ("red", "green", "blue")], axis=-1)
    assert seen.sum() > 200
    assert np.abs(bilinear(image, uv[seen]) - rgb[seen]).mean() < 1.5


def test_depth_images_are_exact_to_half_a_step(exported: Path) -> None:
    about = json.loads((exported / "depth/scale.json").read_text())
    for k in range(truth.T):
        with Image.open(exported / f"depth/frame_{k + 1:04d}.png") as picture:
            assert picture.mode == "I;16"
            depth = np.asarray(picture).astype(float) * about["scale"]
        known, expected = depth > 0, truth.wall(pixel_grid(truth.H, truth.W), k)[1]
        assert np.abs(depth - expected)[known].max() < 0.01
        assert not (known & truth.mask(k)).any()
        assert known[~truth.mask(k)].mean() > 0.9
    archive = np.load(exported / "scene.npz")
    for k in range(truth.T):
        with Image.open(exported / f"depth/frame_{k + 1:04d}.png") as picture:
            steps = np.asarray(picture)
        error = np.abs(archive["depth"][k] - steps * about["scale"])[steps > 0]
        assert error.max() <= about["scale"] * 0.51
        assert steps.max() <= 65535
        assert ((steps > 0) <= archive["depth_known"][k]).all()


def test_masks_are_black_where_something_moves(exported: Path) -> None:
    for k in range(truth.T):
        picture = np.asarray(Image.open(exported / f"masks/frame_{k + 1:04d}.png.png"))
        assert np.array_equal(picture == 0, truth.mask(k))
        assert set(np.unique(picture)) == {0, 255}


def test_the_archive_holds_everything_and_explains_it(exported: Path) -> None:
    archive = np.load(exported / "scene.npz")  # refuses pickled objects
    assert np.allclose(archive["cam_from_world"], truth.CAM_FROM_WORLD)
    assert np.allclose(archive["Ks"], truth.K)
    assert archive["numbers"].tolist() == list(range(1, truth.T + 1))
    assert archive["names"][0] == "frame_0001.png"
    for k in range(truth.T):
        assert np.array_equal(archive["masks"][k], truth.mask(k))
        assert np.array_equal(archive["instances"][k] > 0, truth.mask(k))
    assert archive["depth"].shape == (truth.T, truth.H, truth.W)
    explained = str(archive["conventions"])
    for name in set(archive) - {"conventions"}:
        assert name in explained, name


def test_the_video_shows_the_fly_through(tmp_path: Path) -> None:
    folder = export(tmp_path, "video")
    video = cv2.VideoCapture(str(folder / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(1 / SECONDS_PER_FRAME)
    shown = 0
    while (read := video.read())[0]:
        frame = read[1]
        shown += 1
        with Image.open(tmp_path / f"renders/novel/frame_{shown:04d}.png") as picture:
            render = np.asarray(picture)[: truth.H - 2, : truth.W - 2]  # of 63 x 95 px
        assert frame.shape == render.shape
        assert np.sqrt(np.square(frame[..., ::-1].astype(float) - render).mean()) < 8
    assert shown == truth.T
    assert [path.name for path in folder.iterdir()] == ["video.mp4"]


def test_the_video_has_the_pace_of_the_clip(tmp_path: Path) -> None:
    for number in range(1, 6):
        write_image(tmp_path / f"novel/frame_{number:04d}.png", np.zeros((32, 32, 3), np.uint8))
    write_video(tmp_path / "video.mp4", tmp_path, times_s=[0.0, 0.5])
    assert cv2.VideoCapture(str(tmp_path / "video.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(8)


def test_formats_are_checked_before_anything_runs() -> None:
    with pytest.raises(InputError, match=r"export\.formats.*'colmap'.*found 'kolmap'"):
        configuration.load({"export": {"formats": ["colmap", "kolmap"]}})
    with pytest.raises(InputError, match=r"export\.formats"):
        configuration.load({"export": {"formats": []}})


def test_numbers_that_no_frame_has_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = export(tmp_path, "spz", splat_frames=(99, 2, 0))
    assert "no splats of frames [0, 99]" in caplog.text
    assert [path.name for path in (folder / "splats").iterdir()] == ["frame_0002.spz"]


def test_all_frames_are_a_word_on_the_command_line_too() -> None:
    assert to_flags(ExportOptions()).endswith("--splat-frames all")
    assert validate(ExportOptions, {"splat_frames": ["all"]}, "test") == ExportOptions()
    assert validate(ExportOptions, {"splat_frames": ["3"]}, "test").splat_frames == (3,)


def test_failed_poses_and_missing_inputs_are_one_line_and_no_output(tmp_path: Path) -> None:
    inputs = truth.write_clip(tmp_path, status=np.full(truth.T, "failed", object))
    with pytest.raises(InputError, match=r"expected estimated poses, found the status 'failed' for all 8 frames"):
        export(tmp_path, "colmap", **inputs)
    masks = export(tmp_path, "masks", **inputs) / "masks"
    assert len(list(masks.iterdir())) == truth.T, "masks need no poses"
    shutil.rmtree(tmp_path / "export")
    del inputs["model"], inputs["renders"]
    for name, flag in {"spz": "--model", "video": "--renders"}.items():
        with pytest.raises(InputError, match=flag):
            export(tmp_path, name, **inputs)
    assert not (tmp_path / "export").exists()


def test_without_parallax_there_are_cameras_and_no_points(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    inputs = truth.write_clip(tmp_path, variance=1.0)
    folder = export(tmp_path, "colmap", "nerfstudio", "depth_png", **inputs)
    assert "no depth is triangulated (estimated): no points, and black depth images" in caplog.text
    model = pycolmap.Reconstruction(folder / "sparse/0")
    assert (model.num_reg_images(), model.num_points3D()) == (truth.T, 0)
    assert "ply_file_path" not in json.loads((folder / "transforms.json").read_text())
    assert not np.asarray(Image.open(folder / "depth/frame_0001.png")).any()
