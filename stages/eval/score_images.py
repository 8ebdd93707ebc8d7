"""Rows of the image table: renders against frames, whole and on static and dynamic pixels."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.eval import image_metrics
from stages.shared.images import read_rgb
from stages.shared.sequences import Sequence
from stages.shared.split import SplitOptions, held_out

REGIONS = ("whole", "static", "dynamic")
SPLITS = {
    "train": "frames that were trained on",
    "test": "held-out frames, never trained on",
    "right": "right-eye views against the clean pass, the only one with right-eye truth",
}


def score_images(
    sequence: Sequence, renders: Path, masks: Mapping[int, np.ndarray], mask_source: str, options: SplitOptions
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per split and region, and rows per frame.

    Args:
        renders: folder with train/, test/, right/ (each may be missing), files frame_%04d.png.
        masks: dynamic pixels [H, W] by frame number, for the regions; `mask_source` says whose they are.
    """
    table: list[dict[str, Any]] = []
    frames: list[dict[str, Any]] = []
    for split in SPLITS:
        found = {int(path.stem.removeprefix("frame_")): path for path in sorted((renders / split).glob("frame_*.png"))}
        truth = true_images(sequence, split)
        pairs = {number: (read_rgb(path), read_rgb(truth[number])) for number, path in found.items() if number in truth}
        rows, per_frame = _score(sequence, "ours", split, pairs, masks, mask_source)
        table, frames = table + rows, frames + per_frame
    copies = _nearest_training_frames(sequence, options)
    rows, per_frame = _score(sequence, "nearest training frame", "test", copies, masks, mask_source)
    return table + rows, frames + per_frame


def _score(
    sequence: Sequence,
    method: str,
    split: str,
    pairs: Mapping[int, tuple[np.ndarray, np.ndarray]],
    masks: Mapping[int, np.ndarray],
    mask_source: str,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    scores: dict[str, list[tuple[float, float]]] = {region: [] for region in REGIONS}
    frames = []
    for number, (image, truth) in pairs.items():
        mask = masks.get(number) if split != "right" else None  # the masks belong to the left eye
        of_regions = score_frame(image, truth, mask)
        for region, score in of_regions.items():
            scores[region].append(score)
        psnr, ssim = of_regions["whole"]
        frames.append({"method": method, "split": split, "frame": number, "psnr_db": psnr, "ssim": ssim})
    rows = []
    for region, values in scores.items():
        if values:
            psnr, ssim = np.mean(values, axis=0).tolist()
            height, width = next(iter(pairs.values()))[0].shape[:2]
            row: dict[str, Any] = {"sequence": sequence.name, "method": method, "split": split, "region": region}
            row |= {"psnr_db": psnr, "ssim": ssim, "frames": len(values), "width": width, "height": height}
            rows.append(row | {"protocol": SPLITS[split], "mask_source": None if region == "whole" else mask_source})
    return rows, frames


def score_frame(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> dict[str, tuple[float, float]]:
    """PSNR (dB) and SSIM by region; a region without pixels (or without a mask) is left out.

    Args:
        image: [H, W, 3] uint8.
        truth: [H', W', 3] uint8, reduced to the size of `image` if that is smaller.
        mask: dynamic pixels [H', W'], or None.
    """
    height, width = image.shape[:2]
    if truth.shape[:2] != (height, width):
        truth = cv2.resize(truth, (width, height), interpolation=cv2.INTER_AREA)
    if mask is not None and mask.shape != (height, width):
        mask = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    x, y = image / 255, truth / 255
    similarity = image_metrics.ssim_map(x, y)
    scores = {"whole": (image_metrics.psnr(x, y), float(similarity.mean()))}
    for region, pixels in (("static", ~mask), ("dynamic", mask)) if mask is not None else ():
        inner = image_metrics.inside(pixels)
        if inner.any():
            scores[region] = image_metrics.psnr(x, y, pixels), float(similarity[inner].mean())
    return scores


def true_images(sequence: Sequence, split: str) -> dict[int, Path]:
    """The files that renders of a split are held against, by frame number."""
    if split == "right":
        return sequence.truth.get("clean_right", {})
    return dict(zip(sequence.numbers, sequence.frames, strict=True))


def _nearest_training_frames(sequence: Sequence, options: SplitOptions) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """What a held-out frame scores if one copies the nearest training frame: the least that any method must beat."""
    test = held_out(len(sequence.frames), options)
    train = np.flatnonzero(~test)
    pairs = {}
    for k in np.flatnonzero(test):
        nearest = train[np.argmin(np.abs(train - k))]
        pairs[sequence.numbers[k]] = read_rgb(sequence.frames[nearest]), read_rgb(sequence.frames[k])
    return pairs
