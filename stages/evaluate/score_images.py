"""Rows of the image table: renders against frames, whole and on static and dynamic pixels."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from stages.evaluate import image_baselines, image_metrics
from stages.evaluate.lpips import Distance, load_lpips
from stages.evaluate.options import EvaluateOptions
from stages.shared.images import numbered_frames, read_rgb
from stages.shared.masks import read_burnt_in
from stages.shared.sequences import Sequence

REGIONS = ("whole", "static", "dynamic")
SPLITS = {
    "train": "frames that are not held out; used for training, except those without matches",
    "test": "held-out frames: their images are used neither for training nor for the choice of effects and control "
    "points; flow, masks, depth and poses were estimated from all frames, including these, and each is rendered from "
    "its own estimated pose",
    "right": "right-eye views against the clean pass, the only one with right-eye truth",
}


class Score(NamedTuple):
    """PSNR in dB, SSIM, and LPIPS if its weights are given."""

    psnr_db: float
    ssim: float
    lpips: float | None


def score_images(
    sequence: Sequence,
    renders: Path,
    flow: Mapping[str, np.ndarray],
    regions: tuple[Mapping[int, np.ndarray], str],
    options: EvaluateOptions,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per split and region, and rows per frame.

    Args:
        renders: folder with train/, test/, right/ (each may be missing), files frame_%04d.png.
        flow: columns of flow/pairs.arrow, for the baselines of held-out frames.
        regions: dynamic pixels [H, W] by frame number, and their source.
    """
    burnt_in = read_burnt_in(sequence)
    distance = load_lpips(options.lpips_weights) if options.lpips_weights else None
    table: list[dict[str, Any]] = []
    frames: list[dict[str, Any]] = []
    for method, split, protocol, pairs in _pairs(sequence, renders, flow, options):
        about = {"sequence": sequence.name, "method": method, "split": split, "protocol": protocol}
        masks = regions[0] if split != "right" else {}  # the masks belong to the left eye
        left_out = burnt_in if split != "right" else None
        rows, per_frame = _score(about, pairs, masks, regions[1], distance, left_out)
        table, frames = table + rows, frames + per_frame
    return table, frames


def _pairs(
    sequence: Sequence, renders: Path, flow: Mapping[str, np.ndarray], options: EvaluateOptions
) -> Iterator[tuple[str, str, str, dict[int, tuple[np.ndarray, np.ndarray]]]]:
    """Method, split, protocol, and image and truth by frame number: our renders, then the baselines."""
    for split, protocol in SPLITS.items():
        found = numbered_frames(renders / split)
        truth = true_images(sequence, split)
        pairs = {number: (read_rgb(path), read_rgb(truth[number])) for number, path in found.items() if number in truth}
        yield "ours", split, protocol, pairs
    made = list(image_baselines.made_frames(sequence, flow, options))
    for method, protocol in image_baselines.PROTOCOLS.items():
        pairs = {frame.number: (frame.images[method], frame.truth) for frame in made if method in frame.images}
        yield method, "test", f"{SPLITS['test']}; {protocol}", pairs


def _score(
    about: dict[str, Any],
    pairs: Mapping[int, tuple[np.ndarray, np.ndarray]],
    masks: Mapping[int, np.ndarray],
    mask_source: str,
    distance: Distance | None,
    left_out: np.ndarray | None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per region and rows per frame of one method and split."""
    scores: dict[str, list[Score]] = {region: [] for region in REGIONS}
    frames = []
    for number, (image, truth) in pairs.items():
        of_regions = score_frame(image, truth, masks.get(number), left_out, distance)
        for region, score in of_regions.items():
            scores[region].append(score)
        whole = of_regions["whole"]
        frames.append({**about, "frame": number, "psnr_db": whole.psnr_db, "ssim": whole.ssim})
    rows = []
    for region, values in scores.items():
        if values:
            height, width = next(iter(pairs.values()))[0].shape[:2]
            row: dict[str, Any] = about | {"region": region} | _means(values)
            row |= {"frames": len(values), "width": width, "height": height}
            rows.append(row | {"mask_source": None if region == "whole" else mask_source})
    return rows, frames


def _means(scores: list[Score]) -> dict[str, float | None]:
    """Means of all scores by name; None where there are none."""
    columns = zip(Score._fields, zip(*scores, strict=True), strict=True)
    return {name: None if None in values else float(np.mean(values)) for name, values in columns}


def score_frame(
    image: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray | None,
    left_out: np.ndarray | None = None,
    distance: Distance | None = None,
) -> dict[str, Score]:
    """Scores by region; a region without pixels (or without a mask) is left out.

    Args:
        image: [H, W, 3] uint8.
        truth: [H', W', 3] uint8, reduced to the size of `image` if that is smaller.
        mask: dynamic pixels [H', W'], or None.
        left_out: pixels [H', W'] that do not count, because something is burnt in there, or None.
        distance: LPIPS, if its weights are given.
    """
    truth = reduced(truth, image)
    mask, left_out = (None if pixels is None else _resized(pixels, image) for pixels in (mask, left_out))
    x, y = image / 255, truth / 255
    similarity = image_metrics.ssim_map(x, y)
    whole = None if left_out is None else ~left_out
    over = similarity if whole is None else similarity[image_metrics.inside(whole)]
    lpips = distance(image, truth, whole) if distance else None
    scores = {"whole": Score(image_metrics.psnr(x, y, whole), float(over.mean()), lpips)}
    for region, chosen in (("static", ~mask), ("dynamic", mask)) if mask is not None else ():
        pixels = chosen if whole is None else chosen & whole
        inner = image_metrics.inside(pixels)
        if inner.any():
            lpips = distance(image, truth, pixels) if distance else None
            scores[region] = Score(image_metrics.psnr(x, y, pixels), float(similarity[inner].mean()), lpips)
    return scores


def _resized(pixels: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Pixels [H', W'] bool at the size of `image` [H, W, 3]."""
    height, width = image.shape[:2]
    if pixels.shape == (height, width):
        return pixels
    return cv2.resize(pixels.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0


def reduced(truth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The truth [H', W', 3] at the size of `image` [H, W, 3]."""
    height, width = image.shape[:2]
    if truth.shape == image.shape:
        return truth
    return np.asarray(cv2.resize(truth, (width, height), interpolation=cv2.INTER_AREA))


def true_images(sequence: Sequence, split: str) -> dict[int, Path]:
    """The files that renders of a split are compared with, by frame number."""
    if split == "right":
        return sequence.truth.get("clean_right", {})
    return dict(zip(sequence.numbers, sequence.frames, strict=True))
