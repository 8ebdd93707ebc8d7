"""Records and camera models of COLMAP's files, which we read and write (https://colmap.github.io/format.html)."""

import struct
from typing import NamedTuple

import numpy as np

COUNT = struct.Struct("<Q")
"""The number of records that follow."""
CAMERA = struct.Struct("<iiQQ")
"""Id, number of the model, width, height; float64 parameters follow."""
IMAGE = struct.Struct("<i7di")
"""Id, qw qx qy qz tx ty tz of cam_from_world, camera id; the name with a zero, and the observations follow."""
OBSERVATION = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
"""A pixel of an image and the id of its point."""


class CameraModel(NamedTuple):
    """A camera model: parameters are `focals` focal lengths (1, or fx fy), cx, cy, and those of its distortion.

    `pinhole` says whether it is a pinhole camera where all parameters of the distortion are zero.
    """

    name: str
    focals: int
    parameters: int
    pinhole: bool = True


MODELS = {
    0: CameraModel("SIMPLE_PINHOLE", 1, 3),
    1: CameraModel("PINHOLE", 2, 4),
    2: CameraModel("SIMPLE_RADIAL", 1, 4),
    3: CameraModel("RADIAL", 1, 5),
    4: CameraModel("OPENCV", 2, 8),
    5: CameraModel("OPENCV_FISHEYE", 2, 8, pinhole=False),
    6: CameraModel("FULL_OPENCV", 2, 12),
    7: CameraModel("FOV", 2, 5, pinhole=False),
    8: CameraModel("SIMPLE_RADIAL_FISHEYE", 1, 4, pinhole=False),
    9: CameraModel("RADIAL_FISHEYE", 1, 5, pinhole=False),
    10: CameraModel("THIN_PRISM_FISHEYE", 2, 12, pinhole=False),
    11: CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", 2, 16, pinhole=False),
}
"""COLMAP's camera models by their numbers."""
PINHOLE = 1
"""The number of the model with the parameters fx, fy, cx, cy."""
