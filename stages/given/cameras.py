"""Cameras that a user gives, in our conventions and in pixels of the frames: sizes, ranges, one lens for all frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.given.intrinsics import Intrinsics
from stages.shared.cameras import centred_intrinsics, intrinsics
from stages.shared.conventions import integer_centres
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

FOCALS = (0.2, 20.0)
"""Accepted focal lengths, in longer sides of the frame (views of 136 and 3 degrees): others are in another unit."""
SAME_SHAPE = 0.01
"""Relative difference of aspect ratios up to which pictures count as the same, at another size."""
SAME_LENS = 1e-3
"""Principal points count as equal if they differ by less than this share of the focal length, as do ratios fy / fx."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics K [3, 3] in px, pixel centres at integers, of images of width x height px."""

    K: np.ndarray
    width: int
    height: int


def pinhole(
    source: Path | str,
    model: str,
    size: tuple[int, int],
    parameters: np.ndarray,
    distortion: np.ndarray,
    plain: bool = True,
) -> Lens:
    """The lens of a camera as COLMAP and nerfstudio have it: fx fy cx cy in px, pixel centres at half-integers.

    Every format passes here: a distortion is refused at this place alone.

    Args:
        model: its name. plain: whether it is a pinhole camera where all numbers of the distortion are zero.

    Raises:
        InputError: for a camera with distortion, numbers that are not finite, and images without a pixel.
    """
    if min(size) <= 0:
        raise InputError(source, "the size of the images in px", f"{size[0]} x {size[1]}", "write the cameras again")
    if not np.isfinite([*parameters, *distortion]).all():
        found = ", ".join(f"{number:g}" for number in [*parameters, *distortion])
        raise InputError(source, "finite intrinsics", found, "write the cameras again")
    if not plain or np.any(distortion != 0):
        advice = "undistort the frames first, as by `colmap image_undistorter`, and give the cameras of the result"
        raise InputError(source, "a camera without distortion (PINHOLE, SIMPLE_PINHOLE)", f"model {model}", advice)
    return Lens(integer_centres(intrinsics(*parameters)), *size)


def in_frames(source: Path | str, lens: Lens, frames: Sequence) -> np.ndarray:
    """K [3, 3] of a lens in pixels of the frames, which may show its images at another size.

    Raises:
        InputError: for images of another shape than the frames'.
    """
    across, down = frames.width / lens.width, frames.height / lens.height
    if abs(across / down - 1) > max(SAME_SHAPE, 1 / min(frames.height, lens.height)):
        expected = f"cameras of images shaped like the frames, {frames.width} x {frames.height}"
        advice = "give cameras of the frames as they are used: a video's black bars are cut off"
        raise InputError(source, expected, f"{lens.width} x {lens.height}", advice)
    resized = np.array(lens.K)
    resized[:2] *= [[across], [down]]
    resized[:2, 2] += (np.array([across, down]) - 1) / 2
    return resized


def of_option(option: Intrinsics, frames: Sequence) -> np.ndarray:
    """K [3, 3] in px of the frames that a value of `intrinsics:` gives: one of "px", "mm", "lens"."""
    if option.kind == "lens":
        return intrinsics(*option.numbers)
    focal_px = option.numbers[0]
    if option.kind == "mm":  # the width of a sensor is its longer side, also where frames are upright
        focal_px *= max(frames.width, frames.height) / option.numbers[1]
    return centred_intrinsics(focal_px, frames.width, frames.height)


def check_range(source: Path | str, Ks: np.ndarray, frames: Sequence) -> None:
    """Refuse intrinsics [..., 3, 3] that cannot be those of the frames.

    Raises:
        InputError: for a focal length that is far too short or long, or a principal point beyond the frame.
    """
    advice = "numbers are in px of the frames as they are used: `video: {max_side: ...}` reduces large videos"
    focals = np.stack([Ks[..., 0, 0], Ks[..., 1, 1]]).ravel()
    low, high = (limit * max(frames.width, frames.height) for limit in FOCALS)
    if not ((focals >= low) & (focals <= high)).all():
        wrong = focals[(focals < low) | (focals > high)][0]
        raise InputError(source, f"a focal length of {low:.0f} to {high:.0f} px", f"{wrong:.6g} px", advice)
    across, down = Ks[..., 0, 2].ravel(), Ks[..., 1, 2].ravel()
    inside = (across > 0) & (across < frames.width - 1) & (down > 0) & (down < frames.height - 1)
    if not inside.all():
        k = int(np.argmin(inside))
        expected = f"a principal point within the frames, {frames.width} x {frames.height} px"
        raise InputError(source, expected, f"({across[k]:.6g}, {down[k]:.6g})", advice)


def check_one_lens(source: Path | str, Ks: np.ndarray) -> None:
    """Refuse cameras [T, 3, 3] that differ in more than their focal length.

    Raises:
        InputError: for a principal point or a ratio fy / fx that changes over the frames.
    """
    shape = np.stack([Ks[:, 1, 1] / Ks[:, 0, 0], *(Ks[:, :2, 2] / Ks[0, 0, 0]).T], axis=-1)
    apart = np.abs(shape - shape[0]).max(axis=1)
    if apart.max() > SAME_LENS:
        k = int(apart.argmax())
        expected = "one principal point and one ratio fy / fx for all frames"
        found = f"{_words(Ks[0])}, then {_words(Ks[k])}"
        raise InputError(source, expected, found, "solve for one shared camera, or give `intrinsics:` besides")


def _words(K: np.ndarray) -> str:
    return f"fx {K[0, 0]:.6g} fy {K[1, 1]:.6g} cx {K[0, 2]:.6g} cy {K[1, 2]:.6g}"
