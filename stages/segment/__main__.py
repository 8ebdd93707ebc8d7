"""Refine the motion prior to binary dynamic masks at full resolution."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np

from stages.segment.options import SegmentOptions
from stages.segment.refinement import guarded_thresholds, smooth_along_edges, to_mask, vote
from stages.shared import cli, drawing
from stages.shared.artifacts import atomic_folder, read_dense, write_json
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.images import enlarge, read_mask, read_rgb, write_figure, write_image
from stages.shared.log import logger
from stages.shared.masks import mask_path
from stages.shared.sequences import Sequence, read_sequence

PRIOR_THRESHOLD = 0.5

Masks = Callable[[int, np.ndarray], tuple[np.ndarray, bool]]
"""From a frame's index and picture [H, W, 3] to its mask [H, W] and whether the guard cut it back."""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    prior: Annotated[Path, In("motion/prior.arrow")],
    output: Annotated[Path, Out("folder of masks frame_0001.png, 255 = dynamic, full resolution, and masks.json")],
    figure: Annotated[Path, Out("picture for the report: frames with their masks")],
    options: SegmentOptions,
) -> str:
    """Refine the motion prior to binary dynamic masks.

    The prior is voted on along the flow, spread up to the colour edges of the frame, and cut by hysteresis. A mask may
    be empty. A frame that would be masked beyond --max-share keeps its surest part; masks.json and the log name it.
    Other sources write the masks that refinement is compared with.
    """
    frames = read_sequence(sequence)
    masks = _masks(options, frames, flow, prior)
    shares, guarded = {}, []
    shown, overlays = set(drawing.spread(len(frames.numbers), 6).tolist()), []
    with atomic_folder(output, ("frame_*.png", "masks.json")) as folder:
        for k, (path, number) in enumerate(zip(frames.frames, frames.numbers, strict=True)):
            rgb = read_rgb(path)
            mask, was_guarded = masks(k, rgb)
            write_image(mask_path(folder, number), mask)
            shares[number] = float(mask.mean())
            guarded += [number] if was_guarded else []
            overlays += [drawing.overlay_mask(rgb, mask)] if k in shown else []
        write_json(
            folder / "masks.json", {"dynamic_share": shares, "guarded": guarded, "options": options.model_dump()}
        )
    _tell(frames, shares, guarded, options)
    write_figure(figure, drawing.contact_sheet(overlays, columns=3))
    return f"{np.mean(list(shares.values())):.1%} of the pixels dynamic"


def _masks(options: SegmentOptions, frames: Sequence, flow: Path, prior: Path) -> Masks:
    """The function that computes the mask of a frame, for the chosen source."""
    if options.source == "refined":
        return _refined(options, flow, prior)
    if options.source == "truth":
        return _true(frames)
    threshold = PRIOR_THRESHOLD if options.source == "prior" else np.inf
    probability = read_dense(prior)["probability"].astype(np.float32)
    size = frames.width, frames.height
    return lambda k, _: (enlarge(probability[k], size) > threshold, False)


def _refined(options: SegmentOptions, flow: Path, prior: Path) -> Masks:
    pairs, probability = read_dense(flow), read_dense(prior)["probability"]
    edges = {(int(i), int(j)): e for e, (i, j) in enumerate(zip(pairs["source"], pairs["target"], strict=True))}
    voted = vote(probability, edges, pairs["flow"], pairs["confidence"])

    def mask(k: int, rgb: np.ndarray) -> tuple[np.ndarray, bool]:
        smoothed = smooth_along_edges(voted[k], rgb, options.smoothness, options.colour_sigma)
        high, low = guarded_thresholds(smoothed, options.high, options.low, options.max_share)
        return to_mask(smoothed, high, low, options.min_area), low > options.low

    return mask


def _true(frames: Sequence) -> Masks:
    if not frames.has_truth("motion_mask"):
        expected = "motion_mask beside them, for every frame, for `source: truth`"
        raise InputError(frames.frames[0].parent, expected, "no motion_mask", "set `source: refined`")
    return lambda k, _: (read_mask(frames.truth["motion_mask"][frames.numbers[k]]), False)


def _tell(frames: Sequence, shares: dict[int, float], guarded: list[int], options: SegmentOptions) -> None:
    """Log the shares; warn of guarded frames."""
    logger.info("%s: %.1f %% of the pixels are dynamic", frames.name, 100 * float(np.mean(list(shares.values()))))
    if guarded:
        text = "%s: masks of frames %s were cut back to %.0f %% of the frame, their surest part"
        logger.warning(text, frames.name, guarded, 100 * options.max_share)


if __name__ == "__main__":
    cli.run(main)
