"""The viewer's page in a real browser: it draws what our rasteriser draws, and its controls; the stage's script."""

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gaussian_scene as truth
import numpy as np
import pytest
import scene_page
import torch
from gaussian_training import TRAIN, new_scene
from viewed_scenes import at_rest, brightening, tumbling, with_every_effect

from stages.shared.artifacts import write_model
from stages.shared.cameras import Cameras, make_cameras
from stages.shared.sequences import read_sequence
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import scene_tensors
from stages.viewer import __main__ as viewer_stage
from stages.viewer import instances, packing
from stages.viewer.instances import at_pixels, elected, instance_votes
from stages.viewer.packing import pack_scene
from stages.viewer.page import encoded, render_page

SIZE = (truth.WIDTH, truth.HEIGHT)
CAMERAS = make_cameras(truth.cameras(), truth.K, np.arange(1, truth.T + 1))
LEAST_DB = {"effects": 50.0, "tumbling": 40.0, "rest": 52.0, "brightening": 56.0}
"""Asked for are 35. Packed and blended in half precision, trained scenes reach 54 to 58, these 57, 42, 57 and 57."""
MOMENTS = 4
"""Of the shadows of one scene, fewer than frames."""
USED = """(() => {
  const { state, view } = viewer, log = {}, off = (a, b) => Math.hypot(...a.map((value, k) => value - b[k]));
  const key = (name) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true }));
  log.still = !state.playing;  // the browser prefers reduced motion
  key("End"); log.end = state.time;
  key("ArrowLeft"); log.before = state.time;
  key(" "); log.plays = state.playing; key(" ");
  key("2"); log.dynamic = state.dynamic; key("2");
  key("z"); log.mode = state.mode; key("z");
  const target = [...view.target], where = [...view.centre];
  const canvas = document.getElementById("picture");
  canvas.setPointerCapture = () => {};
  const point = (kind, clientX, clientY) =>
    canvas.dispatchEvent(new PointerEvent(kind, { pointerId: 1, clientX, clientY }));
  point("pointerdown", 100, 100); point("pointermove", 160, 120); point("pointerup", 160, 120);
  log.orbit = { follow: state.follow, moved: off(view.centre, where),
                target: off(view.target, target) };
  canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -300, cancelable: true }));
  log.nearer = view.distance;
  document.getElementById("jump").selectedIndex = 4;
  document.getElementById("jump").dispatchEvent(new Event("change"));
  viewer.draw(1);
  log.jump = { time: state.time, off: off(view.centre, viewer.model.cameraAt(3).centre) };
  const nameless = [...document.querySelectorAll("button, input, select, canvas, img")].filter((part) =>
    !(part.ariaLabel || part.labels?.length || part.alt || part.textContent.trim()));
  log.nameless = nameless.map((part) => part.id);
  const loaded = performance.getEntriesByType("resource").map(({ name }) => name);
  log.loaded = loaded.filter((name) => !name.startsWith("data:"));
  const frame = viewer.model.cameraAt(0), plain = { time: 0, width: 96, height: 64, scale: 1, shown: state };
  log.depth = viewer.splats.depthAt(frame, plain, 60, 10);
  return log;
})()"""


@dataclass(frozen=True)
class Drawn:
    """A scene with the pictures of its page and the views that they are of."""

    scene: GaussianScene
    views: list[scene_page.View]
    pictures: list[np.ndarray]
    page: str
    answer: Any


def cameras_of(unit: float) -> Cameras:
    return make_cameras(truth.cameras(unit), truth.K, np.arange(1, truth.T + 1))


def page_of(name: str, scene: GaussianScene, cameras: Cameras) -> str:
    none = np.zeros(len(scene.anchors) - scene.n_static, np.uint8)
    moments = zip(truth.cameras(), truth.TIMES, strict=True)
    pictures = encoded(np.round(255 * truth.ray_cast(*moment)[0]).astype(np.uint8) for moment in moments)
    return render_page(name, *pack_scene(scene, cameras, truth.TIMES, none), SIZE, pictures)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drawn]:
    """Four scenes, ten views of each, the last with MOMENTS of its shadows; and a page without WebGL2."""
    if scene_page.CHROMIUM is None:
        pytest.skip("no Chromium found to look at the page with")
    units = {"effects": 1.0, "tumbling": 1e4, "rest": 1.0, "brightening": 1.0}
    scenes = {"effects": with_every_effect(), "tumbling": tumbling(1e4), "rest": at_rest()}
    pages = {name: page_of(name, scene, cameras_of(units[name])) for name, scene in scenes.items()}
    scenes |= {"brightening": brightening()}
    under = pack_scene(scenes["brightening"], CAMERAS, truth.TIMES, np.zeros(0, np.uint8))[0]["shadows"].shape[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "SHADOW_BYTES", MOMENTS * under)
        pages |= {"brightening": page_of("brightening", scenes["brightening"], cameras_of(1.0))}
    views = {name: scene_page.views_of(scene, cameras_of(units[name]), SIZE, 10) for name, scene in scenes.items()}
    without = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script></head>"
    pages |= {"without": pages["rest"].replace("</head>", without)}
    answer = f'viewer ? {USED} : !document.getElementById("missing").hidden'
    folder = tmp_path_factory.mktemp("pages")
    packed = {name: scene_page.unit_of(scene) for name, scene in scenes.items()} | {"without": 1.0}
    pictures, answers = scene_page.open_pages(folder, pages, {**views, "without": []}, packed, answer)
    shown = {name: Drawn(scenes[name], views[name], pictures[name], pages[name], answers[name]) for name in scenes}
    return shown | {"without": Drawn(scenes["rest"], [], [], pages["without"], answers["without"])}


@pytest.mark.parametrize("name", list(LEAST_DB))
def test_the_canvas_shows_what_the_rasteriser_draws(drawn: dict[str, Drawn], name: str) -> None:
    found = drawn[name]
    for view, picture in zip(found.views, found.pictures, strict=True):
        expected = scene_page.expected(found.scene, view, truth.T)
        assert scene_page.psnr(picture, expected) > LEAST_DB[name]
        blank = np.broadcast_to(np.round(255 * expected.mean(axis=(0, 1))), expected.shape)
        assert scene_page.psnr(blank, expected) < 30


def test_controls_do_what_they_say(drawn: dict[str, Drawn]) -> None:
    log = drawn["effects"].answer
    assert log["still"]
    assert (log["end"], log["before"], log["plays"]) == (truth.T - 1, truth.T - 2, True)
    assert (log["dynamic"], log["mode"]) == (False, "depth")
    assert log["orbit"]["moved"] > 0.05
    assert log["orbit"]["target"] < 1e-6
    assert not log["orbit"]["follow"]
    assert 0 < log["nearer"] < 1
    assert log["jump"]["time"] == 3
    assert log["jump"]["off"] < 1e-9
    assert log["nameless"] == []
    assert log["loaded"] == []


def test_a_point_that_is_clicked_has_its_depth(drawn: dict[str, Drawn]) -> None:
    """On the wall, from the first camera; in units of the model."""
    unit = scene_page.unit_of(drawn["rest"].scene)
    assert drawn["rest"].answer["depth"] * unit == pytest.approx(truth.WALL_Z, rel=0.05)


def test_without_webgl2_the_page_says_so(drawn: dict[str, Drawn]) -> None:
    assert drawn["without"].answer is True


def test_a_mover_gets_the_instance_that_most_masks_give_it() -> None:
    image = np.zeros((4, 6), np.uint16)
    image[1, 2] = 9
    uv = np.array([[2.2, 0.9], [2.2, 0.9], [-3, 0], [0, 0], [np.nan, np.nan]])
    assert at_pixels(image, uv, np.array([1.0, -1, 1, 1, 1])).tolist() == [9, 0, 0, 0, 0]
    votes = np.array([[9, 0, 0, 4, 9], [9, 9, 0, 0, 9], [4, 0, 0, 4, 0], [0, 0, 0, 0, 9]])
    assert elected(votes).tolist() == [1, 1, 0, 2, 1]
    assert elected(np.zeros((3, 0), int)).tolist() == []


def test_in_a_long_clip_only_what_is_there_votes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two Gaussians at one place: one of what moves there early, one of what comes by much later."""
    T = 200
    chosen = instances.voting_frames(T)
    assert np.diff(chosen).max() <= 9
    assert len(instances.voting_frames(50)) == 8
    image = np.ones((truth.HEIGHT, truth.WIDTH), np.uint16)
    monkeypatch.setattr(instances, "read_instances", lambda _masks, _frames, k: image if k < 150 else 2 * image)

    def there(time: float) -> tuple[torch.Tensor, torch.Tensor]:
        rows = torch.tensor([0, 1] if time < 0.3 else [0, 2] if time > 0.9 else [0])
        return torch.ones(len(rows)), rows

    scene: Any = SimpleNamespace(anchors=torch.zeros(3, 3), n_static=1, opacities_at=there)
    scene.at = lambda _: (torch.tensor([[0.0, 0, 5]] * 3),)
    cameras = make_cameras(np.tile(np.eye(4), (T, 1, 1)), truth.K, np.arange(1, T + 1))
    frames: Any = None
    votes = instance_votes(scene, cameras, np.linspace(0, 1, T), frames, Path(), chosen)
    assert elected(votes).tolist() == [1, 2]


def test_the_script_writes_a_page_of_the_whole_model(tmp_path: Path) -> None:
    truth.write_artifacts(tmp_path)
    scene = new_scene(truth.observations(TRAIN))
    write_model(tmp_path / "model.safetensors", *scene_tensors(scene))
    inputs = {"sequence": tmp_path / "sequence.json", "poses": tmp_path / "poses.parquet", "masks": tmp_path / "masks"}
    viewer_stage.main(**inputs, model=tmp_path / "model.safetensors", output=tmp_path / "scene.html")
    page = (tmp_path / "scene.html").read_text()
    header = json.loads(page.partition('id="scene">')[2].partition("</script>")[0])
    assert header["arrays"]["means"]["shape"] == [len(scene.anchors), 3]
    assert header["frames"] == list(range(1, truth.T + 1))
    assert "http://" not in page.replace("http://www.w3.org", "")
    frames = read_sequence(tmp_path / "sequence.json")
    votes = instance_votes(scene, CAMERAS, truth.TIMES, frames, tmp_path / "masks", np.arange(truth.T))
    assert (elected(votes) == 1).mean() > 0.95  # the masks have one instance, the square
