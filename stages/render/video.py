"""A looping GIF small enough to mail."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from stages.shared.atomic import atomic

MAX_BYTES = 3_000_000
WIDTHS_PX = (512, 400, 320, 240, 160)
COLOURS = 96


def write_gif(path: Path, images: Sequence[np.ndarray], seconds: float) -> None:
    """Write images [H, W, 3] uint8 as a GIF that lasts `seconds`.

    Its width is the first of WIDTHS_PX at which the file has at most MAX_BYTES, or else the last one.
    """
    for width in WIDTHS_PX:
        content = _encode(images, min(width, images[0].shape[1]), 1000 * seconds / len(images))
        if len(content) <= MAX_BYTES:
            break
    with atomic(path) as partial:
        partial.write_bytes(content)


def _encode(images: Sequence[np.ndarray], width: int, milliseconds: float) -> bytes:
    height = round(images[0].shape[0] * width / images[0].shape[1])
    small = [Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS) for image in images]
    # One palette for all frames avoids flicker.
    strip = np.concatenate([np.asarray(image)[::4, ::4] for image in small])
    palette = Image.fromarray(strip).quantize(COLOURS)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in small]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "GIF", save_all=True, append_images=frames[1:], duration=round(milliseconds), loop=0, optimize=False
    )
    return buffer.getvalue()
