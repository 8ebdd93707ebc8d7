"""The scene library, the files that are written, and bad scene files."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from stages.shared import cli, lie, sintel
from stages.shared.cameras import pixel_grid
from stages.shared.errors import InputError
from stages.shared.figures import spread
from stages.simulate import frames, raycast, render, truth
from stages.simulate.frames import Stage
from stages.simulate.scene import load_scene

REPO = Path(__file__).resolve().parents[1]
SCENES = {path.stem: path for path in sorted((REPO / "stages" / "simulate" / "scenes").glob("*.yaml"))}
SMALL: dict[str, Any] = {
    "description": "small",
    "frames": 3,
    "width": 64,
    "height": 32,
    "camera": {
        "keys": [
            {"time": 0, "eye": [0, -4, 1.5], "target": [0, 0, 0.8]},
            {"time": 1, "eye": [0.4, -4, 1.5], "target": [0, 0, 0.8]},
        ]
    },
    "objects": [
        {"name": "ground", "kind": "terrain", "size": [20, 20], "relief": 0.2},
        {"name": "man", "kind": "walker", "path": [{"time": 0}, {"time": 1, "move": [0, 1, 0]}]},
    ],
    "effects": {"noise": {"photons": 1000, "read": 0.01}, "motion_blur": {"shutter": 0.5, "samples": 2}},
}


def drawn_small(name: str) -> tuple[Stage, list[raycast.Hits], list[truth.Motion], np.ndarray]:
    """A library scene at 96 pixels: hits and motion at the first, middle and last pair, and the middle's picture."""
    scene = load_scene(SCENES[name])
    scene = scene.model_copy(update={"width": 96, "height": round(96 * scene.height / scene.width)})
    stage = frames.set_stage(scene, seed=0)
    uv = pixel_grid(scene.height, scene.width).reshape(-1, 2)
    hits, moved = [], []
    for frame in (0, scene.frames // 2, scene.frames - 2):
        view, then = stage.view(frame), frame + 1
        hits.append(raycast.cast(stage.world.at(frame), view, uv))
        moved.append(truth.motion(hits[-1], uv, stage.world, stage.world.at(then), stage.view(then), view.K[0, 0]))
    now = stage.moment(scene.frames // 2)
    seen = frames.see(stage, now)
    clean = frames.develop(stage, now, seen, with_effects=False)
    return stage, hits, moved, frames.final(stage, scene.frames // 2, now, seen, clean)


@pytest.fixture(scope="module")
def library() -> dict[str, tuple[Stage, list[raycast.Hits], list[truth.Motion], np.ndarray]]:
    return {name: drawn_small(name) for name in SCENES}


def test_library_is_complete(library: Any) -> None:
    assert len(library) >= 16
    for name, (stage, hits, moved, picture) in library.items():
        assert "\n" not in stage.scene.description, name
        assert np.isfinite(picture).all(), name
        assert 0.02 < np.median(picture) < 0.7, name
        assert np.std(np.log(np.maximum(picture, 1e-3))) > 0.1, name
        for k in range(3):
            assert (hits[k].depth > 0).all(), name
            assert np.isfinite(moved[k].flow).all(), name
        for frame in spread(stage.scene.frames, 5):
            assert raycast.enclosing(stage.world, stage.world.at(frame), stage.view(frame).centre) is None, name


def test_scenes_have_the_difficulty_that_their_names_promise(library: Any) -> None:
    def moving(name: str) -> np.ndarray:
        return np.array([motion.moving.mean() for motion in library[name][2]])

    def centres(name: str) -> np.ndarray:
        stage = library[name][0]
        return np.array([stage.view(frame).centre for frame in range(stage.scene.frames)])

    def baseline(name: str) -> float:
        return float(np.ptp(centres(name), axis=0).max() / np.median(library[name][1][1].depth))

    assert moving("static_flight").max() == moving("rotation_static").max() == moving("planar_wall").max() == 0
    assert max(baseline("pure_rotation"), baseline("rotation_static")) < 1e-12
    assert moving("pure_rotation").max() > 0.03
    assert moving("large_object").max() > 0.4
    assert moving("all_moving").min() > 0.95
    assert 0.01 < moving("crowd_thin").mean() < 0.2
    assert 0.04 < moving("demo").mean() < 0.12
    assert baseline("demo") > 0.05
    assert baseline("breathing_wall") < 0.05
    assert np.abs(library["fast_chase"][2][1].flow).max() > 0.04 * 96, "pixels of a 96 pixel wide picture"
    assert library["long_take"][0].scene.frames == 200


def test_planar_wall_is_one_plane(library: Any) -> None:
    points = library["planar_wall"][1][1].point
    assert np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1][2] < 1e-9


def test_epipolar_mover_obeys_the_static_epipolar_geometry(library: Any) -> None:
    """Its points move in the world, yet p2^T F p1 = 0 as if they were static."""
    stage, _, moved, _ = library["epipolar_mover"]
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)[moved[0].moving]
    first, second = stage.view(0), stage.view(1)
    relative = second.cam_from_world @ lie.inverse(first.cam_from_world)
    K_inv = np.linalg.inv(first.K)
    F = K_inv.T @ lie.skew(relative[:3, 3]) @ relative[:3, :3] @ K_inv
    start = np.column_stack([uv, np.ones(len(uv))])
    end = np.column_stack([uv + moved[0].flow[moved[0].moving], np.ones(len(uv))])
    lines = start @ F.T
    distance_px = np.abs((end * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert len(uv) > 30
    assert distance_px.max() < 0.5


def write_scene(folder: Path, **changes: Any) -> Path:
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL | changes))
    return path


def run(scene: Path, output: Path, *flags: str, threads: int = 2) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "stages.simulate.render", "--scene", str(scene), "--output", str(output), *flags]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    return subprocess.run(command, cwd=REPO, env=environment, capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_same_seed_same_bytes_on_any_thread_count(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    outputs = [tmp_path / name / "training" for name in ("one", "two", "other")]
    for output, threads, seed in zip(outputs, (1, 2, 2), "001", strict=True):
        done = run(scene, output.parent, "--seed", seed, threads=threads)
        assert (done.returncode, done.stdout) == (0, ""), done.stderr
    one, two, other = map(contents, outputs)
    assert one == two
    assert one != other


def test_files_have_the_sintel_layout_and_round_trip(tmp_path: Path) -> None:
    output = tmp_path / "simulated"
    stale = output / "training" / "clean" / "small" / "frame_0099.png"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"old")
    main(write_scene(tmp_path), output)
    training = output / "training"
    assert not stale.exists()
    assert not list(output.rglob(".*")), "no temporary names are left"
    for kind in render.KINDS:
        count = 2 if kind in ("flow", "occlusions", "invalid") else 3
        stems = [path.stem for path in sorted((training / kind / "small").iterdir())]
        assert stems == [f"frame_{number:04d}" for number in range(1, count + 1)], kind
    copy = tmp_path / "copy"
    for kind, read, write in (
        ("flow", sintel.read_flo, sintel.write_flo),
        ("depth", sintel.read_dpt, sintel.write_dpt),
    ):
        for path in (training / kind / "small").iterdir():
            write(copy, read(path))
            assert copy.read_bytes() == path.read_bytes()
    for path in (training / "camdata_left" / "small").iterdir():
        sintel.write_cam(copy, *sintel.read_cam(path))
        assert copy.read_bytes() == path.read_bytes()
        assert path.stat().st_size == 172
    assert cv2.imread(str(training / "clean" / "small" / "frame_0001.png")).shape == (32, 64, 3)


def main(scene: Path, output: Path, **options: Any) -> None:
    render.main(scene, output, render.RenderOptions(**options))


def test_written_depth_and_cameras_reproduce_the_written_flow(tmp_path: Path) -> None:
    main(write_scene(tmp_path), tmp_path)
    training = tmp_path / "training"
    flow = sintel.read_flo(training / "flow" / "small" / "frame_0002.flo")
    depth = sintel.read_dpt(training / "depth" / "small" / "frame_0002.dpt").astype(float)
    (K, now), (_, then) = (
        sintel.read_cam(training / "camdata_left" / "small" / f"frame_{number:04d}.cam") for number in (2, 3)
    )
    static = cv2.imread(str(training / "motion_mask" / "small" / "frame_0002.png"), 0) == 0
    uv = pixel_grid(*depth.shape)
    rays = np.concatenate([uv, np.ones((*depth.shape, 1))], axis=-1) @ np.linalg.inv(K).T
    world = (rays * depth[..., None] - now[:, 3]) @ now[:, :3]
    projected = (world @ then[:, :3].T + then[:, 3]) @ K.T
    expected = projected[..., :2] / projected[..., 2:] - uv
    assert 0.5 < static.mean() < 1
    assert np.abs(flow - expected)[static].max() < 1e-3


def test_manifest_and_explain_say_what_was_simulated(tmp_path: Path) -> None:
    done = run(write_scene(tmp_path), tmp_path, "--explain")
    assert done.returncode == 0, done.stderr
    manifest = json.loads((tmp_path / "small.json").read_text())
    assert set(manifest["effects"]) == {"noise", "motion_blur"}
    assert {"fog", "shadows", "defocus"} <= set(manifest["not_simulated"])
    assert manifest["seconds"]["noise"] > 0
    assert not set(manifest["not_simulated"]) & set(manifest["seconds"])
    assert re.search(r"^noise +\d+\.\d+ +3 ", done.stdout, re.MULTILINE)
    assert "not simulated: shadows" in done.stdout


@pytest.mark.parametrize(("frames_", "width", "height"), [(2, 1024, 436), (2, 16, 16)])
def test_extreme_sizes(frames_: int, width: int, height: int, tmp_path: Path) -> None:
    main(write_scene(tmp_path, frames=frames_, width=width, height=height, effects={}), tmp_path)
    image = cv2.imread(str(tmp_path / "training" / "final" / "small" / "frame_0002.png"))
    assert image.shape == (height, width, 3)
    clean = tmp_path / "training" / "clean" / "small" / "frame_0002.png"
    assert np.array_equal(image, cv2.imread(str(clean))), "no effect listed: the final pass is the clean one"


BAD = {
    "unknown key": ({"frmes": 3}, "frmes.*did you mean 'frames'"),
    "zero frames": ({"frames": 0}, "frames.*greater than or equal to 2"),
    "too many frames": ({"frames": 1001}, "frames.*less than or equal to 1000"),
    "negative focal": ({"camera": SMALL["camera"] | {"focal": -1}}, r"camera\.focal.*greater than"),
    "not a number": ({"camera": SMALL["camera"] | {"focal": float("nan")}}, r"camera\.focal.*finite"),
    "text": ({"width": "wide"}, "width.*valid integer.*'wide'"),
    "no objects": ({"objects": []}, "objects.*at least 1"),
    "unknown kind": ({"objects": [{"name": "x", "kind": "cone"}]}, r"objects\.0.*box, sphere, cylinder"),
    "missing key": ({"objects": [{"name": "x", "kind": "box"}]}, r"objects\.0\.box\.size.*extent along x, y, z"),
    "wrong key inside": (
        {"objects": [{"name": "x", "kind": "box", "size": [1, 1, 1], "colour": 1}]},
        r"objects\.0\.box\.colour.*known here: .*texture",
    ),
    "effect without parameters": ({"effects": {"fog": None}}, r"effects\.fog\.density.*extinction"),
    "unknown effect": ({"effects": {"bloom": {}}}, r"effects\.bloom.*known here: .*fog"),
    "times out of order": (
        {"camera": {"keys": [SMALL["camera"]["keys"][1], SMALL["camera"]["keys"][0]]}},
        "increasing times",
    ),
    "nowhere to look": ({"camera": {"keys": [{"time": 0, "eye": [0, 0, 1], "target": [0, 0, 1]}]}}, "a target"),
    "under the ground": (
        {"camera": {"keys": [{"time": 0, "eye": [0, -4, -1], "target": [0, 0, 0.8]}]}},
        "inside 'ground' at frame 1",
    ),
    "inside a box": (
        {"objects": [{"name": "shed", "kind": "box", "size": [2, 2, 3], "position": [0, -4, 0]}]},
        "inside 'shed' at frame 1",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_scene_is_one_line_and_leaves_nothing(name: str, tmp_path: Path) -> None:
    changes, expected = BAD[name]
    with pytest.raises(InputError) as refused:
        main(write_scene(tmp_path, **changes), tmp_path / "out")
    assert re.search(expected, str(refused.value)), refused.value
    assert "\n" not in str(refused.value)
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_broken_yaml_exits_with_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("frames: [1, 2\nwidth: 3")
    with pytest.raises(SystemExit) as ended:
        cli.run(render.main, ["--scene", str(broken), "--output", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
