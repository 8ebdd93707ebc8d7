"""The viewer's page: what it draws equals our rasteriser's picture, its controls, its size; all in a real browser."""

import base64
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

from stages.deformation.motion_models import TableDeformation
from stages.shared.artifacts import write_model
from stages.shared.cameras import Cameras, make_cameras
from stages.shared.sequences import read_sequence
from stages.splatting.atmosphere import Atmosphere
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import scene_tensors
from stages.splatting.pose_table import PoseTable
from stages.splatting.shadows import ShadowTable
from stages.viewer import __main__ as viewer_stage
from stages.viewer import instances
from stages.viewer.instances import at_pixels, elected, instance_votes
from stages.viewer.packing import (
    MOTION_BYTES,
    SHADOW_BYTES,
    moments_of_motion,
    pack_scene,
    packed_shadows,
    quantised_pairs,
    quantised_sh,
    to_blob,
)
from stages.viewer.page import PICTURE_BUDGET_BYTES, encoded, render_page

SIZE = (truth.WIDTH, truth.HEIGHT)
CAMERAS = make_cameras(truth.cameras(), truth.K, np.arange(1, truth.T + 1))
LEAST_DB = {"effects": 50.0, "tumbling": 40.0, "rest": 52.0}
"""Asked for are 35. Packed and blended in half precision, trained scenes reach 54 to 58, these 54, 42 and 57."""
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


def with_every_effect() -> GaussianScene:
    """The wall and the square, with colours by view and over time, shadows, gains, corrected poses and fog."""
    scene, random = new_scene(truth.observations(TRAIN)), torch.manual_seed(0)
    cloud = scene.cloud()
    cloud.sh = torch.cat([cloud.sh[:, :1], 0.15 * torch.randn(len(cloud.sh), 15, 3, generator=random)], dim=1)
    scene.set_cloud(cloud)
    times = torch.tensor(truth.TIMES[TRAIN])
    scene.colours, scene.exposure = ColourTable(times, 16), Exposure(times, 3)
    scene.poses = PoseTable(times, length=3.0)
    scene.colours.table.data = 0.4 * torch.randn(len(times), 16, 3, generator=random)
    scene.exposure.log_gains.data = 0.2 * torch.randn(len(times), 3, generator=random)
    points = torch.cat([2 * torch.rand(12, 2, generator=random) - 1, torch.full((12, 1), truth.WALL_Z)], dim=1)
    scene.shadows = ShadowTable(times, points, torch.full((12,), 0.3))
    scene.shadows.table.data = torch.randn(len(times), 12, 1, generator=random) * torch.tensor([0.5, 0.4, 0.2])
    scene.bind()
    scene.atmosphere = Atmosphere(0.7 / truth.WALL_Z, torch.tensor([0.6, 0.3, 0.9]))
    scene.poses.twists.data = 0.01 * torch.randn(len(times), 6, generator=random)
    return scene


def tumbling(unit: float) -> GaussianScene:
    """Gaussians thin and broad, brief and lasting, that eight points turn by up to a turn; lengths times `unit`."""
    random, N = torch.manual_seed(1), 600
    means = torch.randn(N, 3, generator=random) * 0.6 + torch.tensor([0.0, 0, 3])
    cloud = Cloud(
        means=unit * means,
        footprints=torch.full((N,), 0.05 * unit),
        log_scales=torch.randn(N, 3, generator=random) - 3.0 + np.log(unit),
        quats=torch.randn(N, 4, generator=random),
        logits=2 * torch.randn(N, generator=random),
        sh=torch.randn(N, 4, 3, generator=random) * torch.tensor([1, 0.3, 0.3, 0.3])[:, None],
        dynamic=torch.arange(N) >= 200,
    )
    cloud.births = torch.rand(N, generator=random)
    cloud.log_spans[200:] = torch.log(0.05 + 0.5 * torch.rand(N - 200, generator=random))
    cloud.drifts = 0.1 * unit * torch.randn(N, 3, generator=random)
    points = unit * means[200::20]
    motion = TableDeformation(points, torch.full((len(points),), np.log(0.4 * unit)), torch.tensor(truth.TIMES))
    steps = 0.5 * torch.randn(motion.table.shape, generator=random)
    motion.table.data = steps.cumsum(dim=0) * torch.tensor([1.0, 1, 1, 1, 0.2, 0.2, 0.2])
    return GaussianScene(cloud, motion, torch.tensor([0.1, 0.2, 0.3]), 0.3 * unit, neighbours=8)


def at_rest() -> GaussianScene:
    """The wall without the square's motion: no control points at all."""
    return new_scene(truth.observations(TRAIN), moving=False)


def cameras_of(unit: float) -> Cameras:
    return make_cameras(truth.cameras(unit), truth.K, np.arange(1, truth.T + 1))


def page_of(name: str, scene: GaussianScene, cameras: Cameras) -> str:
    none = np.zeros(len(scene.anchors) - scene.n_static, np.uint8)
    moments = zip(truth.cameras(), truth.TIMES, strict=True)
    pictures = encoded(np.round(255 * truth.ray_cast(*moment)[0]).astype(np.uint8) for moment in moments)
    return render_page(name, *pack_scene(scene, cameras, truth.TIMES, none), SIZE, pictures)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drawn]:
    """Three scenes, ten views of each; and a page in a browser without WebGL2."""
    if scene_page.CHROMIUM is None:
        pytest.skip("no Chromium found to look at the page with")
    units = {"effects": 1.0, "tumbling": 1e4, "rest": 1.0}
    scenes = {"effects": with_every_effect(), "tumbling": tumbling(1e4), "rest": at_rest()}
    pages = {name: page_of(name, scene, cameras_of(units[name])) for name, scene in scenes.items()}
    views = {name: scene_page.views_of(scene, cameras_of(units[name]), SIZE, 10) for name, scene in scenes.items()}
    without = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script></head>"
    pages |= {"without": pages["rest"].replace("</head>", without)}
    answer = f'viewer ? {USED} : !document.getElementById("missing").hidden'
    folder = tmp_path_factory.mktemp("pages")
    packed = {name: scene_page.unit_of(scene) for name, scene in scenes.items()} | {"without": 1.0}
    pictures, answers = scene_page.open_pages(folder, pages, {**views, "without": []}, packed, answer)
    shown = {name: Drawn(scenes[name], views[name], pictures[name], pages[name], answers[name]) for name in scenes}
    return shown | {"without": Drawn(scenes["rest"], [], [], pages["without"], answers["without"])}


@pytest.mark.parametrize("name", ["effects", "tumbling", "rest"])
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


def test_the_page_of_50_000_gaussians_and_50_frames_is_below_8_mb() -> None:
    """With harmonics of degree 2, the most that a scene is given, a thousand control points, every fifth Gaussian
    moving, and some under moving shadows."""
    random, N, D, P, T = np.random.default_rng(0), 50_000, 10_000, 1000, 50
    halves = {"quats": (N, 4), "shapes": (N, 4), "sh_dc": (N, 3), "motions": (T, P, 10)}
    arrays = {name: random.normal(size=shape).astype(np.float16) for name, shape in halves.items()}
    arrays |= {"means": random.normal(size=(N, 3)).astype(np.float32), "instances": np.zeros(D, np.uint8)}
    arrays |= {"sh_rest": np.zeros((N, 8, 3), np.int8), "points": np.zeros((P, 3), np.float32)}
    arrays |= {
        "shadows": np.zeros((SHADOW_BYTES // 8000, 8000), np.int8),
        "shadow_colours": np.zeros((8000, 3), np.int8),
    }
    arrays |= {"index": np.zeros((D, 4), np.uint16), "weights": np.zeros((D, 4), np.uint8)}
    noise = [random.integers(0, 255, (1, 27, 64, 3), np.uint8).repeat(8, 1).repeat(10, 2)[0] for _ in range(T)]
    pictures = encoded(image[..., :3] for image in noise)
    assert sum(map(len, pictures)) < PICTURE_BUDGET_BYTES
    assert len(render_page("large", arrays, {}, (640, 216), pictures).encode()) < 8e6


@pytest.mark.parametrize(("T", "P", "moments"), [(50, 1000, 50), (1000, 1000, 120), (1000, 100, 1000)])
def test_motions_of_a_long_clip_are_packed_at_fewer_moments(T: int, P: int, moments: int) -> None:
    scene: Any = SimpleNamespace(deformation=SimpleNamespace(points=np.zeros((P, 3))))
    found = moments_of_motion(scene, np.linspace(0, 1, T))
    np.testing.assert_allclose(found, np.linspace(0, 1, moments))
    assert 20 * P * len(found) <= MOTION_BYTES


@pytest.mark.parametrize("T", [10, 40_000])
def test_gaussians_under_shadows_come_last_of_the_static_ones(T: int) -> None:
    """What is added to their colours, at fewer moments than frames where these take too much."""
    scene, times = with_every_effect(), np.linspace(0, 1, T)
    order, shadows, colours, step = packed_shadows(scene, times)
    n, B = scene.n_static, shadows.shape[1]
    assert scene.shadows is not None
    assert 0 < B < n
    first = scene.shadows.of_static(scene.means[:n], 0.0).detach()
    assert np.array_equal(order[n - B : n], scene.shadows.rows[first.abs().sum(dim=1) > 0])
    assert np.array_equal(np.sort(order), np.arange(len(scene.anchors)))
    assert shadows.nbytes <= SHADOW_BYTES
    shown = first[first.abs().sum(dim=1) > 0].numpy()
    assert np.abs(shadows[0, :, None] / 127 * step * (colours / 127) - shown).max() < step / 100


def test_packed_weights_sum_to_one_and_lose_little() -> None:
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.full(16, 0.3), size=500)
    index = random.permuted(np.tile(np.arange(300), (500, 1)), axis=1)[:, :16]
    packed_index, packed = quantised_pairs(index, weights)
    assert (packed.sum(axis=1, dtype=int) == 255).all()
    assert (np.diff(packed.astype(int), axis=1) <= 1).all()  # heaviest first, up to rounding
    back, there = np.zeros((500, 300)), np.zeros((500, 300))
    np.put_along_axis(back, packed_index.astype(int), packed / 255, axis=1)
    np.put_along_axis(there, index, weights, axis=1)
    assert np.abs(back - there).max() <= 1 / 255


def test_packed_harmonics_err_by_half_a_step() -> None:
    rest = np.random.default_rng(0).normal(size=(100, 3, 3)).astype(np.float32)
    rest[:, 1] = 0
    packed, steps = quantised_sh(rest)
    assert np.abs(packed / 127 * steps - rest).max() <= steps.max() / 254 * 1.001


def test_the_blob_holds_what_its_layout_says() -> None:
    arrays = {"a": np.arange(5, dtype=np.uint8), "b": np.arange(6, dtype=np.float32).reshape(2, 3)}
    text, layout = to_blob(arrays)
    content = base64.b64decode(text)
    for name, array in arrays.items():
        about = layout[name]
        assert about["at"] % 4 == 0
        read = np.frombuffer(content, about["type"], array.size, about["at"]).reshape(about["shape"])
        assert np.array_equal(read, array)


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
