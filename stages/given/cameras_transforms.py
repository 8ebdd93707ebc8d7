"""Cameras of a transforms.json, camera-to-world with OpenGL axes.

Format: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.given.cameras import Lens, pinhole
from stages.given.poses import Poses, rotations
from stages.shared import lie
from stages.shared.conventions import from_opengl
from stages.shared.errors import InputError

ADVICE = "write it as nerfstudio's ns-process-data does"
PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
"""Camera models that are a pinhole camera where all parameters of the distortion are zero."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path) -> Poses:
    """The poses of the frames of a transforms.json, with their cameras.

    Raises:
        InputError: for a file that is not of this format, and cameras with distortion.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        frames = content["frames"]
        names = [str(frame["file_path"]) for frame in frames]
        matrices = np.array([frame["transform_matrix"] for frame in frames], float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = "frames with file_path and transform_matrix, as in a transforms.json"
        raise InputError(path, expected, _lack(error), ADVICE) from error
    if matrices.ndim != 3 or matrices.shape[1:] not in ((4, 4), (3, 4)):
        raise InputError(path, "a transform_matrix of 4 x 4 for every frame", f"shape {matrices.shape[1:]}", ADVICE)
    if not np.isfinite(matrices).all():
        raise InputError(path, "finite numbers in every transform_matrix", "NaN or infinity", ADVICE)
    R = rotations(path, matrices[:, :3, :3], names)
    lenses = [_lens(path, content | frame) for frame in frames]
    known = [lens for lens in lenses if lens is not None]
    world_from_opengl = lie.from_parts(R, matrices[:, :3, 3])
    return Poses(from_opengl(world_from_opengl), names=names, lenses=known if len(known) == len(frames) else None)


def _lack(error: Exception) -> str:
    """What a file of another structure holds, in words."""
    if isinstance(error, KeyError):
        return f"no {error}"
    return "another structure" if isinstance(error, TypeError) else str(error).splitlines()[0][:60] or "none"


def _lens(path: Path, camera: Mapping[str, Any]) -> Lens | None:
    """The camera of a frame with the keys that all frames share; None if it has none, or no size."""
    try:
        width, height = (int(camera[key]) for key in ("w", "h"))
        if "fl_x" in camera:
            fx = float(camera["fl_x"])
            fy = float(camera.get("fl_y", fx))
        else:  # as in the files of Blender's scenes
            fx = width / (2 * np.tan(float(camera["camera_angle_x"]) / 2))
            fy = height / (2 * np.tan(float(camera["camera_angle_y"]) / 2)) if "camera_angle_y" in camera else fx
        centre = float(camera.get("cx", width / 2)), float(camera.get("cy", height / 2))
        distortion = [float(camera.get(key, 0)) for key in DISTORTION]
    except KeyError:
        return None
    except (TypeError, ValueError) as error:
        raise InputError(path, "numbers fl_x, fl_y, cx, cy, w, h", _lack(error), ADVICE) from error
    model = str(camera.get("camera_model", "OPENCV"))
    parameters = np.array([fx, fy, *centre])
    return pinhole(path, model, (width, height), parameters, np.array(distortion), model in PINHOLES)
