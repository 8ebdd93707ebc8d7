"""Images of a scene: one ray per pixel, more at the borders of surfaces, and the effects of the final pass."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stages.shared.cameras import pixel_grid
from stages.simulate import effects
from stages.simulate.keyframes import View, camera_path, right_of
from stages.simulate.raycast import Hits, cast
from stages.simulate.scene import Scene
from stages.simulate.shading import Surface, lit, surfaces
from stages.simulate.stopwatch import Stopwatch
from stages.simulate.world import Snapshot, World

SUBPIXELS = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
"""Rotated-grid samples of a pixel, relative to its centre."""
PLASTIC = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence (Roberts 2018), whose successive points cover a pixel evenly."""
OF_LIGHT = ("shadows", "specular", "fog")
"""Effects that change the radiance of surface points."""


class Moment(NamedTuple):
    """The scene and a camera at one frame index."""

    snapshot: Snapshot
    view: View


class Stage(NamedTuple):
    """The inputs of every image of a scene.

    Attributes:
        scene: the scene file. world: its triangles. view: frame index -> camera of this eye. watch: measures the
            seconds. eye: 0 left, 1 right.
    """

    scene: Scene
    world: World
    view: Callable[[float], View]
    seed: int
    watch: Stopwatch
    eye: int = 0

    def moment(self, frame: float) -> Moment:
        """The scene and the camera at a frame index, which may be fractional."""
        with self.watch.measure("geometry"):
            return Moment(self.world.at(frame), self.view(frame))


def set_stage(scene: Scene, seed: int) -> Stage:
    """Build the triangles and the camera path of a scene."""
    watch = Stopwatch()
    with watch.measure("scene"):
        return Stage(scene, World(scene, seed), camera_path(scene, seed), seed, watch)


def right_eye(stage: Stage, now: Moment) -> tuple[Stage, Moment]:
    """The same before the right camera, timed apart. The noise of its sensor is another."""
    baseline = stage.scene.camera.baseline
    right = stage._replace(view=lambda frame: right_of(stage.view(frame), baseline), watch=Stopwatch(), eye=1)
    return right, now._replace(view=right_of(now.view, baseline))


class Seen(NamedTuple):
    """Surfaces that a camera sees at the centres of all H W pixels, and at the SUBPIXELS of the pixels `edges` [m]."""

    hits: Hits
    surface: Surface
    edges: np.ndarray
    finer_hits: Hits
    finer_surface: Surface


def see(stage: Stage, moment: Moment) -> Seen:
    """Cast the rays of an image: one per pixel, and more at the borders of bodies."""
    height, width = stage.scene.height, stage.scene.width
    uv = pixel_grid(height, width).reshape(-1, 2)
    hits = cast(moment.snapshot, moment.view, uv)
    edges = np.flatnonzero(edge_pixels(hits, stage.world, height, width))
    finer = cast(moment.snapshot, moment.view, (uv[edges, None] + SUBPIXELS).reshape(-1, 2))
    return Seen(hits, surface_at(stage, moment, hits), edges, finer, surface_at(stage, moment, finer))


def develop(stage: Stage, moment: Moment, seen: Seen, with_effects: bool) -> np.ndarray:
    """Radiance [H, W, 3] of an image; `with_effects` adds those of the effects OF_LIGHT that the scene lists."""
    radiance = _radiance(stage, moment, seen.hits, seen.surface, with_effects)
    finer = _radiance(stage, moment, seen.finer_hits, seen.finer_surface, with_effects)
    radiance[seen.edges] = finer.reshape(-1, len(SUBPIXELS), 3).mean(axis=1)
    return radiance.reshape(stage.scene.height, stage.scene.width, 3)


def final(stage: Stage, frame: int, moment: Moment, seen: Seen, clean: np.ndarray) -> np.ndarray:
    """The final pass [H, W, 3], linear radiance: the clean pass with the effects that the scene lists.

    Args:
        frame: 0-based index. seen: surfaces of this frame. clean: [H, W, 3] radiance without effects.
    """
    listed, measure = stage.scene.effects, stage.watch.measure
    radiance, depth = clean, seen.hits.depth
    if listed.rolling_shutter:
        with measure("rolling_shutter"):
            radiance, depth = _rolling_shutter(stage, frame)
    if listed.motion_blur:
        with measure("motion_blur"):
            radiance = _motion_blur(stage, frame)
    elif not listed.rolling_shutter and any(getattr(listed, name) for name in OF_LIGHT):
        radiance = develop(stage, moment, seen, with_effects=True)
    if listed.defocus:
        with measure("defocus"):
            radiance = effects.defocus(listed.defocus, radiance, depth.reshape(radiance.shape[:2]))
    if listed.vignette:
        with measure("vignette"):
            radiance = effects.vignette(listed.vignette, radiance)
    if listed.flicker:
        with measure("flicker"):
            radiance = effects.flicker(listed.flicker, radiance, frame)
    if listed.exposure:
        with measure("exposure"):
            time = frame / (stage.scene.frames - 1)
            radiance = effects.exposure(listed.exposure, radiance, time, stage.seed)
    if listed.noise:
        with measure("noise"):
            radiance = effects.noise(listed.noise, radiance, frame, stage.seed, stage.eye)
    return radiance


def surface_at(stage: Stage, moment: Moment, hits: Hits) -> Surface:
    """Texture and orientation at the surface points of rays of the moment's camera."""
    view = moment.view
    return surfaces(stage.world, moment.snapshot, stage.scene.lights, hits, view.centre, view.K[0, 0])


def edge_pixels(hits: Hits, world: World, height: int, width: int) -> np.ndarray:
    """Pixels [H, W] bool with a neighbour on another body, or whose depth differs by more than 5 %."""
    body = np.where(hits.face >= 0, world.body[hits.face], -1).reshape(height, width)
    depth = np.log(hits.depth).reshape(height, width)
    edges = np.zeros((height, width), bool)
    across = (body[:, 1:] != body[:, :-1]) | (np.abs(np.diff(depth, axis=1)) > 0.05)
    down = (body[1:] != body[:-1]) | (np.abs(np.diff(depth, axis=0)) > 0.05)
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def pixel_offsets(count: int) -> np.ndarray:
    """Points [count, 2] that cover a pixel evenly, relative to its centre; their mean is the centre."""
    points = np.arange(1, count + 1)[:, None] * np.array(PLASTIC) % 1
    return np.asarray(points - points.mean(axis=0))


def to_srgb(radiance: np.ndarray) -> np.ndarray:
    """8-bit sRGB values of linear radiance, clipped to 0..1, of any shape (IEC 61966-2-1)."""
    linear = np.clip(radiance, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray((encoded * 255 + 0.5).astype(np.uint8))


def _motion_blur(stage: Stage, frame: int) -> np.ndarray:
    """Mean radiance over the open time of the shutter; each sample has another position within the pixel."""
    blur = stage.scene.effects.motion_blur
    assert blur is not None
    shape = (stage.scene.height, stage.scene.width, 3)
    uv = pixel_grid(*shape[:2]).reshape(-1, 2)
    total = np.zeros((len(uv), 3))
    for k, offset in enumerate(pixel_offsets(blur.samples)):
        time = frame + blur.shutter * ((k + 0.5) / blur.samples - 0.5)
        if stage.scene.effects.rolling_shutter:
            total += _row_by_row(stage, time, uv + offset, np.arange(len(uv)))[0]
        else:
            total += _look(stage, stage.moment(time), uv + offset)[0]
    return total.reshape(shape) / blur.samples


def _rolling_shutter(stage: Stage, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [H, W, 3] and depth [H W] of an image whose rows are exposed one after the other."""
    height, width = stage.scene.height, stage.scene.width
    uv = pixel_grid(height, width).reshape(-1, 2)
    radiance, hits = _row_by_row(stage, frame, uv, np.arange(len(uv)))
    edges = np.flatnonzero(edge_pixels(hits, stage.world, height, width))
    if len(edges):
        places = (uv[edges, None] + SUBPIXELS).reshape(-1, 2)
        finer, _ = _row_by_row(stage, frame, places, np.repeat(edges, len(SUBPIXELS)))
        radiance[edges] = finer.reshape(-1, len(SUBPIXELS), 3).mean(axis=1)
    return radiance.reshape(height, width, 3), hits.depth


def _row_by_row(stage: Stage, frame: float, uv: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, Hits]:
    """Radiance [n, 3] and surface points of rays through uv [n, 2], each at the time of the row of its pixel [n].

    Args:
        frame: time of the middle row. pixels: indices in 0..H W in ascending order.
    """
    rolling, height = stage.scene.effects.rolling_shutter, stage.scene.height
    assert rolling is not None
    rows = pixels // stage.scene.width
    times = frame + rolling.readout * (np.arange(height) / (height - 1) - 0.5)
    parts = np.split(np.arange(len(uv)), np.flatnonzero(np.diff(rows)) + 1)
    looks = [_look(stage, stage.moment(times[rows[part[0]]]), uv[part]) for part in parts]
    hits = Hits(*(np.concatenate(column) for column in zip(*(seen for _, seen in looks), strict=True)))
    return np.concatenate([radiance for radiance, _ in looks]), hits


def _look(stage: Stage, moment: Moment, uv: np.ndarray) -> tuple[np.ndarray, Hits]:
    """Radiance [n, 3], with the effects OF_LIGHT, and surface points of rays through uv [n, 2] at one time."""
    hits = cast(moment.snapshot, moment.view, uv)
    return _radiance(stage, moment, hits, surface_at(stage, moment, hits), with_effects=True), hits


def _radiance(stage: Stage, moment: Moment, hits: Hits, surface: Surface, with_effects: bool) -> np.ndarray:
    """Radiance [n, 3] of n surface points; `with_effects` adds those of the effects OF_LIGHT that the scene lists."""
    listed, lights, centre = stage.scene.effects, stage.scene.lights, moment.view.centre
    sunlight = np.ones(len(hits.face))
    if with_effects and listed.shadows:
        with stage.watch.measure("shadows"):
            sunlight = effects.shadows(listed.shadows, moment.snapshot, lights, hits, surface)
    radiance = lit(surface, lights, sunlight)
    if with_effects and listed.specular:
        with stage.watch.measure("specular"):
            radiance += sunlight[:, None] * effects.specular(listed.specular, lights, hits, surface, centre)
    if with_effects and listed.fog:
        with stage.watch.measure("fog"):
            radiance = effects.fog(listed.fog, radiance, hits, centre)
    return radiance
