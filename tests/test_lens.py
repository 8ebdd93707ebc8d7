"""The lens stage: nothing where there is no distortion; frames, flow and truth of a pinhole where there is one."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, exact_flow, flow_arrays, make_scene

from stages.evaluate.score_lens import lens_rows
from stages.lens.__main__ import _share, main
from stages.lens.carry import carried_grid, carried_sequence, carry_flow, carry_images
from stages.lens.options import LensOptions
from stages.lens.pinhole import Pinhole, largest_pinhole, reduced
from stages.shared import sintel
from stages.shared.artifacts import Dense, read_dense, read_json, read_metadata, write_dense, write_json
from stages.shared.cameras import make_cameras, pixel_grid
from stages.shared.images import read_mask, read_rgb, reduced_size, write_image
from stages.shared.masks import read_burnt_in
from stages.shared.sequences import Sequence, read_sequence, sequence_to_json

SIZE = (96, 160)
BARREL, PINCUSHION = np.array([-0.15, 0.0]), np.array([0.15, 0.02])


def coordinates(scene: Scene) -> np.ndarray:
    """A picture [h, w, 3] of where a pinhole would show its pixels."""
    uv = scene.pinhole(pixel_grid(*SIZE), 0) - [79.5, 47.5]
    return np.round(128 + np.dstack([uv, np.zeros(SIZE)])).clip(0, 255).astype(np.uint8)


def write_clip(folder: Path, scene: Scene, truth: bool = True) -> Sequence:
    """Frames, their truth, sequence.json and the exact flow of a scene."""
    numbers = list(range(1, scene.T + 1))
    frames = [folder / f"clip/frame_{n:04d}.png" for n in numbers]
    for path in frames:
        write_image(path, coordinates(scene))
    files: dict[str, dict[int, Path]] = {"depth": {}, "camdata_left": {}, "flow": {}}
    for k, n in enumerate(numbers if truth else []):
        files["depth"][n] = folder / f"depth_{n}.dpt"
        sintel.write_dpt(files["depth"][n], scene.depth[k])
        files["camdata_left"][n] = folder / f"camera_{n}.cam"
        sintel.write_cam(files["camdata_left"][n], scene.K, scene.cam_from_world[k, :3])
        if n < scene.T:
            files["flow"][n] = folder / f"flow_{n}.flo"
            sintel.write_flo(files["flow"][n], exact_flow(scene, k, k + 1)[0])
    clip = Sequence("clip", frames, numbers, SIZE[1], SIZE[0], files)
    write_json(folder / "sequence.json", sequence_to_json(clip) | {"frames_sha256": "0"})
    columns = dict(zip(("source", "target", "flow", "confidence"), flow_arrays(scene), strict=True))
    columns |= {name: columns[name].astype(np.float16) for name in ("flow", "confidence")}
    write_dense(
        folder / "pairs.arrow",
        columns,
        {"width": SIZE[1], "height": SIZE[0], "scale": 1.0, "source": "dis", "border_px": 8},
    )
    return clip


def run(folder: Path, **options: str) -> dict[str, Path]:
    out = {name: folder / "lens" / file for name, file in (
        ("undistorted", "sequence.json"), ("pairs", "pairs.arrow"), ("images", "images"), ("lens", "lens.json")
    )}  # fmt: skip
    main(folder / "sequence.json", folder / "pairs.arrow", **out, options=LensOptions(**options))  # type: ignore[arg-type]
    return out


@pytest.mark.parametrize("options", [{}, {"distortion": "no"}], ids=["decided", "refused"])
def test_frames_of_a_pinhole_are_taken_as_they_are(tmp_path: Path, options: dict[str, str]) -> None:
    scene = make_scene(size=SIZE, lens=BARREL if options else None)
    write_clip(tmp_path, scene, truth=False)
    out = run(tmp_path, **options)
    assert out["undistorted"].read_text() == (tmp_path / "sequence.json").read_text()
    assert out["pairs"].stat().st_ino == (tmp_path / "pairs.arrow").stat().st_ino
    assert not list(out["images"].iterdir())
    about = read_json(out["lens"])
    assert (about["decision"], about["coefficients_px"]) == ("not tested" if options else "straight", None)


def test_a_distorted_clip_becomes_that_of_a_pinhole(tmp_path: Path) -> None:
    scene, pinhole = make_scene(size=SIZE, lens=BARREL), make_scene(size=SIZE)
    write_clip(tmp_path, scene)
    out = run(tmp_path)
    about, content = read_json(out["lens"]), read_json(out["undistorted"])
    assert about["decision"] == "distorted"
    assert about["coefficients_px"][0] * scene.focal_px**2 == pytest.approx(-0.15, rel=0.05)
    assert about["original"]["frames"][0].endswith("clip/frame_0001.png")
    assert (content["width"], content["height"]) == SIZE[::-1]
    assert "radial distortion" in content["warnings"][-1]
    columns = read_dense(out["pairs"])
    about = read_metadata(out["pairs"])
    assert (about["source"], about["border_px"]) == ("dis", 8)
    for e, (i, j) in enumerate(zip(columns["source"], columns["target"], strict=True)):
        flow, visible = exact_flow(pinhole, i, j)
        apart = np.linalg.norm(columns["flow"][e] - flow, axis=-1)[visible & (columns["confidence"][e] > 0.9)]
        assert np.median(apart) < 0.05
        assert np.percentile(apart, 95) < 0.5


@pytest.mark.parametrize("k", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_pictures_and_truth_are_those_of_a_pinhole(tmp_path: Path, k: np.ndarray) -> None:
    scene, straight = make_scene(T=3, size=SIZE, lens=k), make_scene(T=3, size=SIZE)
    clip = write_clip(tmp_path, scene)
    pinhole = largest_pinhole(k / scene.focal_px ** np.array([2, 4]), clip)
    assert (pinhole.left > 0, pinhole.top > 0) == ((k[0] > 0,) * 2)
    folder = tmp_path / "images"
    folder.mkdir()
    for kind in ("motion_mask", "mover_mask"):  # the left half of the frame, as the lens shows it
        clip.truth[kind] = {1: tmp_path / f"{kind}.png"}
        write_image(clip.truth[kind][1], coordinates(scene)[..., 0] < 128)
    carry_images(clip, pinhole, folder)
    content = carried_sequence(sequence_to_json(clip), clip, pinhole, folder, "undistorted")
    inside = np.s_[pinhole.top : SIZE[0] - pinhole.top, pinhole.left : SIZE[1] - pinhole.left]
    picture = read_rgb(Path(content["frames"][0])).astype(int)
    assert np.abs(picture - coordinates(straight)[inside]).max() <= 1
    depth = sintel.read_dpt(Path(content["truth"]["depth"]["1"]))
    assert np.mean(np.abs(depth / straight.depth[0][inside] - 1) < 0.02) > 0.97
    flow, visible = exact_flow(straight, 0, 1)
    found = sintel.read_flo(Path(content["truth"]["flow"]["1"]))
    assert np.median(np.abs(found - flow[inside])[visible[inside]]) < 0.05
    K, _ = sintel.read_cam(Path(content["truth"]["camdata_left"]["1"]))
    assert_allclose(K[:2, 2], [(content["width"] - 1) / 2, (content["height"] - 1) / 2])
    assert K[0, 0] == scene.focal_px
    for kind in ("motion_mask", "mover_mask"):
        mask = read_mask(Path(content["truth"][kind]["1"]))
        assert np.mean(mask == (coordinates(straight)[inside][..., 0] < 128)) > 0.98


@pytest.mark.parametrize("k", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_what_is_burnt_in_is_marked_where_the_undistorted_frames_show_it(tmp_path: Path, k: np.ndarray) -> None:
    """A logo in a corner, by far the brightest of the frame, lies at other pixels of the undistorted one."""
    burnt_in = np.zeros(SIZE, bool)
    burnt_in[8:20, 130:150] = True
    for path, values in (("frame_0001.png", burnt_in[..., None].repeat(3, axis=2)), ("mask.png", burnt_in)):
        write_image(tmp_path / path, 255 * values.astype(np.uint8))
    clip = Sequence("clip", [tmp_path / "frame_0001.png"], [1], SIZE[1], SIZE[0], burnt_in=tmp_path / "mask.png")
    pinhole = largest_pinhole(k / 150 ** np.array([2, 4]), clip)
    (tmp_path / "images").mkdir()
    carry_images(clip, pinhole, tmp_path / "images")
    content = carried_sequence(sequence_to_json(clip), clip, pinhole, tmp_path / "images", "undistorted")
    write_json(tmp_path / "sequence.json", content | {"frames_sha256": "0"})
    carried = read_sequence(tmp_path / "sequence.json")
    marked, shown = read_burnt_in(carried), read_rgb(carried.frames[0])[..., 0]
    assert marked is not None
    assert not (shown[~marked] > 25).any()
    assert marked.sum() < 1.6 * (shown > 128).sum()


def test_no_pixel_of_the_new_image_lies_outside_of_the_old_one_and_the_maps_are_inverse() -> None:
    clip = Sequence("clip", [Path("a.png")], [1], 320, 137)
    for k in (BARREL, PINCUSHION, np.array([0.1, -0.15])):
        pinhole = largest_pinhole(k / 300 ** np.array([2, 4]), clip)
        shown = pinhole.sources()
        assert shown.min() >= -0.5
        assert (shown.max(axis=(0, 1)) <= [319.5, 136.5]).all()
        assert_allclose(pinhole.from_original(shown), pixel_grid(pinhole.height, pinhole.width), atol=1e-6)


@pytest.mark.parametrize("size", [(158, 399), (399, 158), (101, 255)])
def test_a_whole_image_keeps_the_grid_of_its_flow(size: tuple[int, int]) -> None:
    grid = reduced_size(*size, 256)
    assert reduced(Pinhole(np.zeros(2), size, 0, 0), grid[0] / size[0]) == grid


def test_matches_that_leave_the_new_image_are_not_confident() -> None:
    flow = np.zeros((1, 40, 60, 2), np.float16)
    flow[..., 0] = 10
    ends = {"source": np.array([0]), "target": np.array([1])}
    columns = Dense({**ends, "flow": flow, "confidence": np.ones((1, 40, 60))})
    pinhole = Pinhole(np.array([1e-5, 0]), (120, 80), 4, 3)
    [(_, carried, confidence)] = carry_flow(columns, pinhole)
    assert carried.shape[1:3] == confidence.shape[1:] == (37, 56)
    assert carried_grid(columns, pinhole) == ((56, 37), 56 / 112)
    assert (confidence[0, :, -9:] == 0).all()
    assert (confidence[0, :, :40] == 1).all()


def test_the_error_of_a_lens_is_told_at_a_corner_of_the_image(tmp_path: Path) -> None:
    scene = make_scene(T=3, size=SIZE, lens=BARREL)
    clip = write_clip(tmp_path, scene)
    truth = tmp_path / "lens.json"
    write_json(truth, {"k1": -0.15, "k2": 0.0})
    clip.truth["distortion"] = dict.fromkeys(clip.numbers, truth)
    cameras = make_cameras(scene.cam_from_world, scene.K, np.array(clip.numbers))
    about = {"coefficients_px": [-0.12 / scene.focal_px**2, 0.0]}
    rows = {row["quantity"]: row["value"] for row in lens_rows(clip, about, cameras)}
    assert rows["radial distortion, k1"] == pytest.approx(-0.12)
    radius_px = np.hypot(79.5, 47.5)
    assert rows["error of the lens at a corner"] == pytest.approx(0.03 * radius_px**3 / scene.focal_px**2)
    assert lens_rows(clip, {"coefficients_px": None}, cameras) == []


def test_one_more_name_of_the_flow_is_all_that_there_is(tmp_path: Path) -> None:
    """Snakemake touches what a job has written: by a third name it would make all results of the flow old."""
    flow, first, second = (tmp_path / f"{name}.arrow" for name in ("flow", "first", "second"))
    flow.write_bytes(b"flow")
    _share(flow, first)
    before = flow.stat().st_mtime_ns
    _share(flow, second)
    os.utime(second)
    assert first.samefile(flow)
    assert second.read_bytes() == b"flow"
    assert (flow.stat().st_mtime_ns, flow.stat().st_nlink) == (before, 2)
