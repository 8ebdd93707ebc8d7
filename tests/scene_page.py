"""Pictures that the viewer's page draws in a headless browser, and what our rasteriser draws of the same view."""

import base64
import html
import json
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.shared import lie
from stages.shared.cameras import Cameras
from stages.splatting.gaussian_model import GaussianScene
from stages.viewer.packing import length_unit

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--force-prefers-reduced-motion", "--enable-logging=stderr", "--virtual-time-budget=20000"),
]
FRAME = """<body><script>
const found = {}, pages = PAGES;
addEventListener("message", ({ data }) => {
  const { name, ...rest } = JSON.parse(data);
  found[name] = rest;
  if (Object.keys(found).length === pages.length) document.body.dataset.found = JSON.stringify(found);
});
for (const name of pages) {
  const frame = document.createElement("iframe");
  frame.src = `${name}.html`;
  Object.assign(frame.style, { width: "900px", height: "600px" });
  document.body.append(frame);
}
</script></body>"""
PROBE = """<script>
{
  const text = (bytes) => { let t = ""; for (const byte of bytes) t += String.fromCharCode(byte); return btoa(t); };
  const pictures = VIEWS.map(({ camera, width, height, time, mode }) =>
    text(viewer.pixels(camera, width, height, time, mode)));
  const answer = ANSWER;
  parent.postMessage(JSON.stringify({ name: NAME, pictures, answer }), "*");
}
</script></body>"""


@dataclass(frozen=True)
class View:
    """A picture to draw: cam_from_world [4, 4] in scene units, corrected as the scene's are; K; the time in frames."""

    cam_from_world: np.ndarray
    K: np.ndarray
    size: tuple[int, int]
    time: float
    mode: str = "colour"

    def for_page(self, unit: float) -> dict[str, object]:
        """The arguments of `App.pixels`, in the units of the packed model."""
        rows, shift = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3] / unit
        camera = {"rows": rows.tolist(), "centre": (-rows.T @ shift).tolist()}
        camera["lens"] = [self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2]]
        return {
            "camera": camera,
            "width": self.size[0],
            "height": self.size[1],
            "time": self.time,
            "mode": self.mode,
        }


def open_pages(
    folder: Path,
    pages: Mapping[str, str],
    views: Mapping[str, list[View]],
    units: Mapping[str, float],
    answer: str = "0",
) -> tuple[dict[str, list[np.ndarray]], dict[str, object]]:
    """The pictures [H, W, 3] uint8 of the views of each page, and the value of a script expression in it.

    Fails on anything that a page writes to the console.
    """
    for name, page in pages.items():
        asked = json.dumps([view.for_page(units[name]) for view in views[name]])
        probe = PROBE.replace("VIEWS", asked).replace("NAME", json.dumps(name)).replace("ANSWER", answer)
        (folder / f"{name}.html").write_text(page.replace("</body>", probe))
    (folder / "all.html").write_text(FRAME.replace("PAGES", json.dumps(list(pages))))
    command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={folder / 'profile'}", "--dump-dom", str(folder / "all.html")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    match = re.search(r'<body data-found="([^"]*)"', done.stdout)
    assert match, done.stderr[-2000:]
    found = json.loads(html.unescape(match[1]))
    pictures = {}
    for name in pages:
        drawn = zip(found[name]["pictures"], views[name], strict=True)
        pictures[name] = [_image(content, view.size) for content, view in drawn]
    return pictures, {name: found[name]["answer"] for name in pages}


def _image(content: str, size: tuple[int, int]) -> np.ndarray:
    rgba = np.frombuffer(base64.b64decode(content), np.uint8).reshape(size[1], size[0], 4)
    return rgba[::-1, :, :3]  # WebGL reads from the bottom row up


def unit_of(scene: GaussianScene) -> float:
    return length_unit(scene.means.detach().double().numpy())


@torch.no_grad()
def expected(scene: GaussianScene, view: View, T: int) -> np.ndarray:
    """What our rasteriser draws, [H, W, 3] in 0..1."""
    time, pose = view.time / (T - 1), view.cam_from_world
    if scene.poses is not None:  # the scene corrects what it is given; the page holds corrected cameras
        pose = lie.inverse(scene.poses(time).numpy()) @ pose
    drawn = scene.render(time, torch.tensor(pose), torch.tensor(view.K), *view.size)
    return drawn.colour[0].numpy().clip(0, 1)


def views_of(scene: GaussianScene, cameras: Cameras, size: tuple[int, int], count: int) -> list[View]:
    """`count` views of a scene: every other one from a camera of the clip, the rest shifted and turned beside it."""
    random, T = np.random.default_rng(0), len(cameras.numbers)
    views = []
    for n in range(count):
        k = n * (T - 1) // max(count - 1, 1)
        pose = cameras.cam_from_world[k]
        if scene.poses is not None:
            pose = scene.poses(k / (T - 1)).detach().numpy() @ pose
        if n % 2:
            shift, turn = random.normal(scale=0.03 * unit_of(scene), size=3), random.normal(scale=0.05, size=3)
            pose = lie.exp_se3(np.concatenate([shift, turn])) @ pose
        views.append(View(pose, cameras.Ks[k], size, float(k)))
    return views


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """PSNR in dB of an image uint8 against a truth in 0..1."""
    return float(-10 * np.log10(np.square(image / 255 - truth).mean()))
