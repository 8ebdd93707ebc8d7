"""Pictures of the report as data URIs, small enough to mail."""

import base64
import io
from pathlib import Path

import cv2
import numpy as np

from stages.shared.drawing import contact_sheet, overlay_instances, scalar_to_rgb, spread

ATTEMPTS = ((65, 1.0), (50, 1.0), (35, 1.0), (35, 0.7), (25, 0.5), (15, 0.35))
"""Quality and share of the width, tried in this order until a picture is small enough."""
WIDTH_PX, MAX_BYTES = 1000, 55_000
STAGE_WIDTH_PX, STAGE_MAX_BYTES = 800, 27_000
ANIMATION_WIDTH_PX, ANIMATION_FRAMES, ANIMATION_MAX_BYTES = 340, 14, 80_000
"""With these limits a report on fourteen sequences stays below 15 MB for any content."""
DIFFERENCE_GAIN = 4.0
TRUE_EDGE = (0, 200, 255)


def data_uri(content: bytes, kind: str) -> str:
    """Data URI of `content` with a media type such as "image/webp"."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def webp(image: np.ndarray, width_px: int = WIDTH_PX, max_bytes: int = MAX_BYTES) -> str:
    """An RGB image [H, W, 3] uint8 as the data URI of a WebP of at most `width_px` and, if possible, `max_bytes`."""
    height, width = image.shape[:2]
    for quality, share in ATTEMPTS:
        size = round(share * min(width, width_px)), round(share * height * min(1, width_px / width))
        reduced = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        _, encoded = cv2.imencode(".webp", reduced[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
        if encoded.size <= max_bytes:
            break
    return data_uri(encoded.tobytes(), "image/webp")


def animation(path: Path) -> str:
    """A GIF as the data URI of an animated WebP, at most 340 px wide, with 14 frames over the same time."""
    from PIL import Image, ImageSequence

    with Image.open(path) as gif:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(gif)]
        shown = spread(len(frames), ANIMATION_FRAMES)
        duration_ms = round(gif.info.get("duration", 80) * len(frames) / len(shown))
    width, height = frames[0].size
    for quality, share in ATTEMPTS[2:]:
        wide = share * min(width, ANIMATION_WIDTH_PX)
        first, *others = (frames[k].resize((round(wide), round(wide * height / width))) for k in shown)
        content = io.BytesIO()
        looped = {"duration": duration_ms, "loop": 0, "quality": quality}
        first.save(content, "WEBP", save_all=True, append_images=others, **looped)
        if content.tell() <= ANIMATION_MAX_BYTES:
            break
    return data_uri(content.getvalue(), "image/webp")


def mask_sheet(images: list[np.ndarray], instances: list[np.ndarray], truths: list[np.ndarray | None]) -> np.ndarray:
    """Frames [H, W, 3] with instances [H, W] tinted, a colour for each, and the outline of the true masks in blue."""
    drawn = []
    for image, numbers, truth in zip(images, instances, truths, strict=True):
        sheet = overlay_instances(image, numbers)
        if truth is not None:
            edge = cv2.morphologyEx(truth.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
            sheet[edge] = TRUE_EDGE
        drawn.append(sheet)
    return contact_sheet(drawn, columns=2)


def comparison_sheet(pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Truth, render and absolute difference times 4 of pairs (truth, render), both [H, W, 3] uint8, side by side."""
    cells = []
    for truth, render in pairs:
        if truth.shape != render.shape:
            truth = cv2.resize(truth, render.shape[1::-1], interpolation=cv2.INTER_AREA)
        difference = DIFFERENCE_GAIN * np.abs(truth.astype(float) - render).mean(axis=-1)
        cells += [truth, render, scalar_to_rgb(difference, 0, 255)]
    return contact_sheet(cells, columns=3)


def depth_sheet(inverse_depths: np.ndarray, true_depths: list[np.ndarray | None]) -> np.ndarray:
    """Our inverse depth [n, h, w] of frames and, if known, the true one [H, W] in the same colours, side by side."""
    low, high = np.percentile(inverse_depths, [2, 98])
    cells = []
    for ours, truth in zip(inverse_depths, true_depths, strict=True):
        size = (truth.shape[1], truth.shape[0]) if truth is not None else (4 * ours.shape[1], 4 * ours.shape[0])
        cells.append(cv2.resize(scalar_to_rgb(ours, low, high), size, interpolation=cv2.INTER_LINEAR))
        if truth is not None:
            small = cv2.resize(truth, ours.shape[::-1], interpolation=cv2.INTER_NEAREST)
            scale = np.median(ours * small)  # brings the true inverse depth to our unit
            cells.append(scalar_to_rgb(scale / truth, low, high))
    return contact_sheet(cells, columns=2)
