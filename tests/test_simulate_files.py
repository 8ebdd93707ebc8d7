"""The files that the simulator writes, and scene files that it refuses."""

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

from stages.shared import cli, sintel
from stages.shared.cameras import pixel_grid
from stages.shared.digest import code_digest
from stages.shared.errors import InputError
from stages.simulate import __main__ as simulate_stage
from stages.simulate import gallery

REPO = Path(__file__).resolve().parents[1]
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


def write_scene(folder: Path, **changes: Any) -> Path:
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL | changes))
    return path


def run(scene: Path, output: Path, *flags: str, threads: int = 2) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "stages.simulate", "--scene", str(scene), "--output", str(output), *flags]
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
    for kind in simulate_stage.KINDS:
        numbers = {"flow": [1, 2], "occlusions": [1, 2], "invalid": [1, 2], "final_right": [3]}.get(kind, [1, 2, 3])
        stems = [path.stem for path in sorted((training / kind / "small").iterdir())]
        assert stems == [f"frame_{number:04d}" for number in numbers], kind
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
    simulate_stage.main(scene, output, simulate_stage.RenderOptions(**options))


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


def test_masks_are_of_a_frame_and_of_the_clip(tmp_path: Path) -> None:
    """A box that moves on the way to the last frame alone: the last one counts as the one before it."""
    path = [{"time": 0}, {"time": 0.67}, {"time": 1, "move": [0.5, 0, 0]}]
    box = {"name": "box", "kind": "box", "size": [1, 1, 1], "position": [0, 0, 0.8], "path": path}
    main(write_scene(tmp_path, frames=4, objects=[SMALL["objects"][0], box], effects={}), tmp_path)
    moving, mover = (
        np.stack([cv2.imread(str(file), 0) > 0 for file in sorted((tmp_path / f"training/{kind}/small").iterdir())])
        for kind in ("motion_mask", "mover_mask")
    )
    assert [frame.any() for frame in moving] == [False, False, True, True]
    assert np.array_equal(moving[2:], mover[2:])
    assert mover[:2].sum(axis=(1, 2)).min() > 50


def test_manifest_and_explain_say_what_was_simulated(tmp_path: Path) -> None:
    done = run(write_scene(tmp_path), tmp_path, "--explain", "--stats", str(tmp_path / "stats.json"))
    assert done.returncode == 0, done.stderr
    manifest = json.loads((tmp_path / "small.json").read_text())
    assert set(manifest["effects"]) == {"noise", "motion_blur"}
    assert {"fog", "shadows", "defocus"} <= set(manifest["not_simulated"])
    assert manifest["seconds"]["noise"] > 0
    assert not set(manifest["not_simulated"]) & set(manifest["seconds"])
    assert re.search(r"^noise +\d+\.\d+ +3 ", done.stdout, re.MULTILINE)
    assert "not simulated: shadows" in done.stdout
    assert manifest["split"] == "own"
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert (stats["threads"], stats["code"]) == (
        int(os.environ["OMP_NUM_THREADS"]),
        code_digest("stages.simulate"),
    )


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
        cli.run(simulate_stage.main, ["--scene", str(broken), "--output", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_gallery_shows_every_scene(tmp_path: Path) -> None:
    """One scene: a 512 pixel wide picture over its caption, scaled to the sheet."""
    write_scene(tmp_path)
    gallery.main(tmp_path, tmp_path / "sheet.png", gallery.GalleryOptions(columns=1, width_px=512))
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (256 + 34, 512, 3)
    assert sheet[:256].std() > 10
    assert (sheet[256:] < 100).any(), "the caption is written"
