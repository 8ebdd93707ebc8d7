"""Videos that the tests encode, of a texture that moves."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

SIZE = 96, 64
"""Width and height of the frames."""


def moving(count: int, seed: int = 0, step: tuple[int, int] = (2, 1), size: tuple[int, int] = SIZE) -> list[np.ndarray]:
    """Frames [H, W, 3] uint8 of a smooth random texture that moves by `step` px per frame."""
    width, height = size
    noise = np.random.default_rng(seed).uniform(0, 255, (height + count * step[1], width + count * step[0], 3))
    texture = cv2.GaussianBlur(noise, (0, 0), 2)
    texture = 255 * (texture - texture.min()) / np.ptp(texture)
    return [
        texture[k * step[1] : k * step[1] + height, k * step[0] : k * step[0] + width].astype(np.uint8)
        for k in range(count)
    ]


def encode(
    path: Path,
    images: Sequence[np.ndarray],
    times_ms: Sequence[int] | None = None,
    codec: str = "libx264",
    pix_fmt: str = "yuv444p",
    rotation_deg: int = 0,
    aspect: int = 1,
    container: dict[str, str] | None = None,
    **options: str,
) -> Path:
    """Encode images as a video of 25 frames per second, or at their own times.

    Args:
        rotation_deg: counterclockwise turn that the metadata ask of a player. aspect: width of a pixel over its height.
        container, options: of the container and of the encoder.
    """
    with av.open(str(path), "w", options=container or {}) as file:
        stream: Any = file.add_stream(codec, rate=25, options={"crf": "4", "preset": "veryfast", **options})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.codec_context.sample_aspect_ratio = pix_fmt, Fraction(aspect)
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        if times_ms:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            if times_ms:
                frame.pts, frame.time_base = times_ms[k], Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def encode_sound(path: Path) -> Path:
    """A second of silence."""
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream("aac", rate=16000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path
