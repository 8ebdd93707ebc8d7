"""One archive with all that was estimated, in our own conventions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.export.archive import Stack, write_npz
from stages.export.clip import Clip
from stages.export.points import Points
from stages.shared.split import frame_times

CONVENTIONS = """OpenCV axes: x right, y down, z forward; pixel centres at integers; lengths in scene units.
cam_from_world [T, 4, 4]: x_camera = cam_from_world x_world; the first camera is the world.
Ks [T, 3, 3]: pixels of the full-size frames, u = Ks x_camera / z.
numbers, names, times [T]: frame numbers, file names, times 0..1 of the model; width, height: px.
has_pose [T]: false where the pose was not estimated but interpolated; status [T] says more.
covariance [T, 6, 6]: of the left twist [translation, rotation in radians] of cam_from_world.
depth [T, H, W]: z-depth, at every pixel; depth_known [T, H, W]: where it is triangulated and static, not filled in.
masks [T, H, W]: true where something moves; instances [T, H, W]: what moves together has one number, 0 is static.
points [N, 3], colours [N, 3]: static points in the world with RGB 0..255."""
"""What stands in the archive, as its entry `conventions`."""


def write_everything(path: Path, clip: Clip, points: Points) -> None:
    """Write the archive; what has a value per pixel goes through memory one frame at a time."""
    content, cameras = clip.content, clip.cameras
    T, size = len(clip.posed), (content.height, content.width)

    def stack(dtype: Any, of_frame: Callable[[int], np.ndarray]) -> Stack:
        return Stack((T, *size), dtype, map(of_frame, range(T)))

    arrays: dict[str, np.ndarray | Stack] = {
        "conventions": np.array(CONVENTIONS),
        "cam_from_world": cameras.cam_from_world,
        "Ks": cameras.Ks,
        "numbers": cameras.numbers,
        "names": np.array(clip.names),
        "times": frame_times(T),
        "width": np.array(content.width),
        "height": np.array(content.height),
        "has_pose": clip.posed,
        "status": cameras.status.astype(str),
        "covariance": cameras.covariance,
        "depth": stack(np.float32, clip.depth),
        "depth_known": stack(bool, clip.depth_known),
        "masks": stack(bool, clip.mask),
        "instances": stack(np.uint16, clip.instances),
        "points": points.xyz,
        "colours": points.rgb,
    }
    write_npz(path, arrays)
