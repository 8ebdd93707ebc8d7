"""The views to render, by time and camera, and their rendering."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.render.options import RenderOptions
from stages.render.viewpoints import novel_path, right_eye
from stages.shared import sintel
from stages.shared.alignment import DegenerateError
from stages.shared.cameras import Cameras
from stages.shared.images import to_uint8
from stages.shared.log import logger
from stages.shared.sequences import Sequence
from stages.shared.split import frame_times, held_out
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import read_scene
from stages.splatting.rasterize import backend_name, choose_device
from stages.splatting.shutter import Shutter, expose, instant, open_moments


@dataclass(frozen=True)
class Shot:
    """One image to render.

    Attributes:
        split: its folder, "train", "test", "novel" or "right". number: the number in its file name. time: 0..1.
        cam_from_world: [4, 4]. K: [3, 3] px.
        shutter: that of its motion blur, with the cameras of all frames; None: it is sharp.
        frame: 0-based index of the frame that the shutter is open for; unused without one.
    """

    split: str
    number: int
    time: float
    cam_from_world: np.ndarray
    K: np.ndarray
    shutter: Shutter | None = None
    frame: int = 0


def planned_shots(
    content: Sequence, cameras: Cameras, distance: float, options: RenderOptions, open_for: float | None = None
) -> list[Shot]:
    """All views of the stage: every frame at its pose, the fly-through, and the right eye.

    Args:
        distance: of the point that the fly-through looks at, scene units.
        open_for: how long the shutter is open, in frames, 0..1; None: nothing is blurred.
    """
    T, poses = len(content.frames), cameras.cam_from_world
    times, is_test = frame_times(T), held_out(T, options)
    shutter = None if open_for is None else Shutter(open_for, poses, cameras.Ks)
    shots = [
        Shot("test" if is_test[k] else "train", content.numbers[k], times[k], poses[k], cameras.Ks[k], shutter, k)
        for k in range(T)
    ]
    moments = even_moments(content.times_s, options.novel_views)
    path = novel_path(poses, moments, options.orbit_share * distance, distance)
    nearest = np.rint(moments * (T - 1)).astype(int)  # of a lens that zooms
    shots += [Shot("novel", n + 1, moments[n], path[n], cameras.Ks[nearest[n]]) for n in range(len(moments))]
    return shots + _right_shots(content, cameras, times, open_for)


def _right_shots(content: Sequence, cameras: Cameras, times: np.ndarray, open_for: float | None) -> list[Shot]:
    """The right eye of the frames that have one on disk, blurred as they are if it is of the final pass.

    The path of the right eye while the shutter is open needs its camera at every frame: where one is missing, all views
    are sharp.
    """
    rows, eyes = right_cameras(content, cameras.cam_from_world)
    shutter = None
    if open_for is not None and content.right_kind == "final_right" and len(rows) == len(times):
        shutter = Shutter(open_for, eyes, cameras.Ks)
    on_disk = content.truth.get(content.right_kind, {})
    return [
        Shot("right", content.numbers[k], times[k], eye, cameras.Ks[k], shutter, k)
        for k, eye in zip(rows.tolist(), eyes, strict=True)
        if content.numbers[k] in on_disk
    ]


def even_moments(times_s: list[float] | None, count: int) -> np.ndarray:
    """Moments [count] of the model's time 0..1, even in real time, by the time stamps [T], or even over the frames."""
    if times_s is None:
        return np.linspace(0, 1, count)
    return np.interp(np.linspace(times_s[0], times_s[-1], count), times_s, frame_times(len(times_s)))


def right_cameras(content: Sequence, cam_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices [n] of the frames whose right camera is known, and these cameras [n, 4, 4] in the estimated world.

    Args:
        cam_from_world: estimated [T, 4, 4]. Where the estimated path does not determine a scale, none are returned.
    """
    known = content.truth.get("camdata_right", {})
    rows = np.array([k for k, number in enumerate(content.numbers) if number in known], int)
    if len(rows) == 0 or not content.has_truth("camdata_left"):
        return rows[:0], np.zeros((0, 4, 4))
    _, left = sintel.read_cams(content.truth_files("camdata_left"))
    _, right = sintel.read_cams(content.truth["camdata_right"][content.numbers[k]] for k in rows)
    try:
        return rows, right_eye(cam_from_world, left, right, rows)
    except DegenerateError as error:
        logger.warning("no right-eye views: the scale of the estimated world is unknown (%s)", error)
        return rows[:0], np.zeros((0, 4, 4))


def load_scene(model: Path, device: str) -> GaussianScene:
    """The trained scene of a model file in full or half precision, on the device "auto", "cpu" or "cuda".

    Raises:
        InputError: if the file is not the model of a scene.
    """
    chosen = choose_device(device)
    logger.info("rendering by %s", backend_name(chosen))
    return read_scene(model).to(chosen)


@torch.no_grad()
def take(scene: GaussianScene, shot: Shot, width: int, height: int) -> np.ndarray:
    """The rendered view, [height, width, 3] uint8, with the motion blur of its shutter, if any."""
    picture = instant(shot.time, shot.cam_from_world, shot.K)
    if shot.shutter is not None:
        picture = open_moments(scene, shot.shutter, shot.frame, (width, height))
    return to_uint8(expose(scene, picture, width, height)[0].cpu().numpy())
