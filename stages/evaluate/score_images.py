"""Rows of the image table: renders against frames, whole and on static and dynamic pixels."""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from stages.evaluate import image_baselines, image_metrics
from stages.evaluate.lpips import Distance, load_lpips
from stages.evaluate.options import EvaluateOptions
from stages.shared.artifacts import Dense
from stages.shared.images import numbered_frames, read_rgb
from stages.shared.log import progress
from stages.shared.masks import read_burnt_in
from stages.shared.sequences import Sequence

REGIONS = ("whole", "static", "dynamic")
SPLITS = {
    "train": "frames that are not held out, used for training; those without matches are neither trained on nor scored",
    "test": "held-out frames: their images are used neither for training nor for the choice of effects and control "
    "points; flow, masks, depth and poses were estimated from all frames, including these, and each is rendered from "
    "its own estimated pose; frames without matches are not scored",
    "right": "right-eye views against the right eye of the frames' own pass, or of the clean one if it has none; "
    "frames without matches are not scored",
}


class Score(NamedTuple):
    """PSNR in dB, SSIM, and LPIPS if its weights are given."""

    psnr_db: float
    ssim: float
    lpips: float | None


@dataclass
class _Method:
    """What one method scores on one split: by region, and frame by frame; the size of its images."""

    about: dict[str, Any]
    scores: dict[str, list[Score]] = field(default_factory=lambda: {region: [] for region in REGIONS})
    frames: list[dict[str, Any]] = field(default_factory=list)
    size: tuple[int, ...] = (0, 0)

    def add(self, number: int, image: np.ndarray, of_regions: Mapping[str, Score]) -> None:
        """The scores of a frame."""
        self.size = self.size if self.frames else image.shape[:2]
        for region, score in of_regions.items():
            self.scores[region].append(score)
        whole = of_regions["whole"]
        self.frames.append({**self.about, "frame": number, "psnr_db": whole.psnr_db, "ssim": whole.ssim})

    def rows(self, mask_source: str) -> list[dict[str, Any]]:
        """A row per region."""
        found = []
        for region, values in self.scores.items():
            if values:
                row: dict[str, Any] = self.about | {"region": region} | _means(values)
                row |= {"frames": len(values), "width": self.size[1], "height": self.size[0]}
                found.append(row | {"mask_source": None if region == "whole" else mask_source})
        return found


def score_images(
    sequence: Sequence,
    renders: Path,
    flow: Dense,
    regions: tuple[Mapping[int, np.ndarray], str],
    options: EvaluateOptions,
    unobserved: Container[int] = (),
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per split and region, and rows per frame.

    Args:
        renders: folder with train/, test/, right/ (each may be missing), files frame_%04d.png.
        flow: columns of flow/pairs.arrow, for the baselines of held-out frames.
        regions: dynamic pixels [H, W] by frame number, and their source.
        unobserved: numbers of frames that are not scored: they are not trained on either, and their poses are guesses.
    """
    burnt_in = read_burnt_in(sequence)
    distance = load_lpips(options.lpips_weights) if options.lpips_weights else None
    methods = []
    for split, protocol in SPLITS.items():
        ours = _Method({"sequence": sequence.name, "method": "ours", "split": split, "protocol": protocol})
        masks = regions[0] if split != "right" else {}  # the masks belong to the left eye
        # The right eye shows what is burnt in if it is of the frames' own pass with effects; a clean one may not.
        left_out = burnt_in if split != "right" or sequence.right_kind == "final_right" else None
        found, true = numbered_frames(renders / split), true_images(sequence, split)
        numbers = [number for number in sorted(set(found) & set(true)) if number not in unobserved]
        for number in progress(numbers, f"renders: {split}"):
            image, truth = read_rgb(found[number]), read_rgb(true[number])
            ours.add(number, image, score_frame(image, truth, masks.get(number), left_out, distance))
        methods.append(ours)
    made_by = {
        method: _Method(ours.about | {"method": method, "split": "test", "protocol": f"{SPLITS['test']}; {protocol}"})
        for method, protocol in image_baselines.PROTOCOLS.items()
    }
    for made in image_baselines.made_frames(sequence, flow, options):
        if made.number in unobserved:
            continue
        for method, image in made.images.items():
            scores = score_frame(image, made.truth, regions[0].get(made.number), burnt_in, distance)
            made_by[method].add(made.number, image, scores)
    methods += made_by.values()
    return [row for one in methods for row in one.rows(regions[1])], [row for one in methods for row in one.frames]


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
        return sequence.truth.get(sequence.right_kind, {})
    return dict(zip(sequence.numbers, sequence.frames, strict=True))
