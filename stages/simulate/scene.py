"""The scene file: objects and their motion, the camera and its path, light and effects.

World axes: x right, y forward, z up, in metres. The `time` of keyframes is 0..1 over the clip; frequencies are in
hertz at 24 frames per second.
"""

import itertools
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from stages.shared.errors import InputError
from stages.shared.lens import fold
from stages.shared.options import Options, validate
from stages.simulate.effect_models import Effects
from stages.simulate.shape_models import Colour, Shape, Vec3

FRAMES_PER_SECOND = 24


class CameraKey(Options):
    """Position and target of the camera at one time."""

    time: float = Field(ge=0, le=1, description="0 at the first frame, 1 at the last")
    eye: Vec3 = Field(description="camera centre, metres")
    target: Vec3 = Field(description="the point it looks at, metres")
    zoom: float = Field(1.0, gt=0.05, le=20, description="factor on the focal length")

    @model_validator(mode="after")
    def _looks_somewhere(self) -> "CameraKey":
        if all(abs(a - b) < 1e-6 for a, b in zip(self.eye, self.target, strict=True)):
            raise ValueError("a target different from the eye")
        return self


class Handheld(Options):
    """Smooth random camera shake: a sum of sines between 0.2 and 3 Hz."""

    position: float = Field(0.0, ge=0, le=1, description="metres, standard deviation per axis")
    rotation_deg: float = Field(0.0, ge=0, le=20, description="degrees, standard deviation per axis")


class Distortion(Options):
    """Radial distortion of the lens: x_d = x (1 + k1 r^2 + k2 r^4) on rays with z = 1 (OpenCV, COLMAP's RADIAL)."""

    k1: float = Field(0.0, ge=-1, le=1, description="below 0: barrel; above 0: pincushion")
    k2: float = Field(0.0, ge=-1, le=1, description="the same of the fourth power")


class Camera(Options):
    """A camera on a smooth path through its keyframes; a pinhole unless it has a distortion."""

    focal: float = Field(1.1, gt=0.1, le=10, description="focal length in image widths")
    keys: list[CameraKey] = Field(min_length=1, description="keyframes in order of time")
    handheld: Handheld = Handheld()
    baseline: float = Field(0.1, gt=0, le=10, description="distance of the right camera, metres")
    distortion: Distortion | None = Field(None, description="of the lens; null: none, and nothing is computed")

    @model_validator(mode="after")
    def _in_order(self) -> "Camera":
        times = [key.time for key in self.keys]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("keyframes with increasing times")
        return self


class Lights(Options):
    """A sun and a sky that lights from above; radiances are in units of display white."""

    sun_from: Vec3 = Field((-0.4, -0.5, 0.8), description="direction towards the sun")
    sun: Colour = Field((1.3, 1.16, 0.92), description="linear RGB")
    sky: Colour = Field((0.25, 0.32, 0.44), description="linear RGB light from above")
    bounce: Colour = Field((0.11, 0.09, 0.07), description="linear RGB light from below")
    horizon: Colour = Field((0.62, 0.68, 0.74), description="linear RGB of the sky at the horizon")
    zenith: Colour = Field((0.13, 0.27, 0.56), description="linear RGB of the sky overhead")
    clouds: float = Field(0.6, ge=0, le=1, description="cloud cover")

    @model_validator(mode="after")
    def _has_direction(self) -> "Lights":
        if sum(x * x for x in self.sun_from) < 1e-12:
            raise ValueError("a sun direction other than zero")
        return self


class Scene(Options):
    """One scene file."""

    description: str = Field(description="one line: what is difficult about the scene")
    split: Literal["tuned", "test"] | None = Field(
        None, description="tuned: thresholds were chosen on it; test: nobody tunes on it; null: not in the library"
    )
    frames: int = Field(14, ge=2, le=1000, description="number of frames")
    width: int = Field(512, ge=16, le=1024, description="pixels")
    height: int = Field(218, ge=16, le=436, description="pixels")
    camera: Camera
    lights: Lights = Lights()
    objects: list[Shape] = Field(min_length=1)
    effects: Effects = Effects()

    @model_validator(mode="after")
    def _sees_its_corners(self) -> "Scene":
        lens, widest = self.camera.distortion, min(key.zoom for key in self.camera.keys) * self.camera.focal
        if lens is not None:
            corner = np.hypot(1, self.height / self.width) / 2 / widest
            reach = fold(np.array([lens.k1, lens.k2]))
            if np.isfinite(reach) and reach * (1 + reach**2 * (lens.k1 + reach**2 * lens.k2)) < corner:
                raise ValueError("a distortion that shows something in the corners: a weaker one, or a longer lens")
        return self


def load_scene(path: Path) -> Scene:
    """Read and check a scene file.

    Raises:
        InputError: one line that names the wrong key and its valid values.
    """
    try:
        raw: Any = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)  # ten times as fast as in Python
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(path, "a YAML scene file", " ".join(str(error).split()), "correct the file") from error
    if not isinstance(raw, dict):
        raise InputError(
            path, "keys such as `frames:` and `objects:`", f"a {type(raw).__name__}", "see scenes/demo.yaml"
        )
    return validate(Scene, raw, path.name)
