"""Pictures for the report: colour codes, overlays and contact sheets as [H, W, 3] uint8 RGB."""

from collections.abc import Sequence

import cv2
import numpy as np

MASK_COLOUR = np.array([255, 60, 40])
BURNT_IN_COLOUR = np.array([255, 0, 255])
"""Of logos, time codes and bars: magenta, which no instance has."""
INSTANCE_COLOURS = np.array([MASK_COLOUR, (255, 187, 0), (44, 160, 44), (227, 119, 194), (23, 190, 207), (140, 86, 75)])
"""Of instances 1, 2, ..., over and over. Blue is left for what is true."""
LONG_CLIP = 100
"""Frames up to which evenly spread ones show what is in a clip."""
GAP_PX = 4
"""Distance between the images of a contact sheet."""


def flow_to_rgb(flow: np.ndarray, max_px: float | None = None) -> np.ndarray:
    """Colours [H, W, 3] uint8 of flow [H, W, 2] px: hue is direction, saturation is length.

    Args:
        max_px: length of full saturation; None: the 98th percentile.
    """
    length = np.linalg.norm(flow, axis=-1)
    limit = max_px if max_px is not None else float(np.percentile(length, 98))
    angle = np.arctan2(flow[..., 1], flow[..., 0])
    hue = ((angle + np.pi) / (2 * np.pi) * 179).astype(np.uint8)
    saturation = np.clip(255 * length / max(limit, 1e-6), 0, 255).astype(np.uint8)
    hsv = np.stack([hue, saturation, np.full_like(hue, 255)], axis=-1)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))


def scalar_to_rgb(values: np.ndarray, low: float | None = None, high: float | None = None) -> np.ndarray:
    """Colour map (dark violet to yellow) of values [H, W] from `low` to `high` (default: 2nd and 98th percentile)."""
    finite = values[np.isfinite(values)]
    low = low if low is not None else float(np.percentile(finite, 2)) if finite.size else 0.0
    high = high if high is not None else float(np.percentile(finite, 98)) if finite.size else 1.0
    unit = np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-12), 0, 1)
    coloured = cv2.applyColorMap((unit * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(coloured[..., ::-1])


def overlay_mask(rgb: np.ndarray, mask: np.ndarray, colour: np.ndarray = MASK_COLOUR) -> np.ndarray:
    """The frame [H, W, 3] with `mask` [H, W] tinted and outlined."""
    tinted = np.where(mask[..., None], 0.5 * rgb + 0.5 * colour, rgb).astype(np.uint8)
    edge = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    tinted[edge] = colour
    return tinted


def overlay_instances(rgb: np.ndarray, instances: np.ndarray) -> np.ndarray:
    """The frame [H, W, 3] with the pixels of instances [H, W], 0 for none, tinted and outlined, a colour for each."""
    picture = rgb
    for number in np.unique(instances[instances > 0]):
        colour = INSTANCE_COLOURS[(int(number) - 1) % len(INSTANCE_COLOURS)]
        picture = overlay_mask(picture, instances == number, colour)
    return picture


def contact_sheet(images: Sequence[np.ndarray], columns: int, width_px: int = 1200) -> np.ndarray:
    """Images [H, W, 3] in rows of `columns` on white, scaled so that the sheet is `width_px` wide.

    Rows of upright images are put side by side in pairs: one above the other they would be several screens high.
    """
    if images[0].shape[0] > images[0].shape[1]:
        columns = min(2 * columns, max(columns, len(images)))
    cell = (width_px - GAP_PX * (columns - 1)) // columns
    height = round(images[0].shape[0] * cell / images[0].shape[1])
    rows = -(-len(images) // columns)
    sheet = np.full((rows * (height + GAP_PX) - GAP_PX, width_px, 3), 255, np.uint8)
    for k, image in enumerate(images):
        y, x = k // columns * (height + GAP_PX), k % columns * (cell + GAP_PX)
        sheet[y : y + height, x : x + cell] = cv2.resize(image, (cell, height), interpolation=cv2.INTER_AREA)
    return sheet


def spread(T: int, count: int) -> np.ndarray:
    """At most `count` frame indices [n] spread evenly over T frames, first and last included."""
    return np.unique(np.linspace(0, T - 1, min(count, T)).round().astype(int))


def fullest(shares: np.ndarray, count: int) -> np.ndarray:
    """Indices of the largest of `shares` [T] in each of `count` equal parts of a long clip; of a short one `spread`.

    In a long clip what moves may be in view in none of the frames of `spread`.
    """
    T = len(shares)
    if T <= LONG_CLIP:
        return spread(T, count)
    return np.array([part[np.argmax(shares[part])] for part in np.array_split(np.arange(T), count)])
