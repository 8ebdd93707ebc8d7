"""Refine the motion prior to binary dynamic masks at full resolution."""

from pathlib import Path
from typing import Annotated

import numpy as np

from stages.segment.options import SegmentOptions
from stages.segment.refinement import guarded_thresholds, smooth_along_edges, to_mask, vote
from stages.shared import cli, figures
from stages.shared.artifacts import atomic_folder, read_dense, write_json
from stages.shared.cli import In, Out
from stages.shared.images import read_rgb, write_figure, write_image
from stages.shared.log import logger
from stages.shared.sequences import Sequence, read_sequence


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    prior: Annotated[Path, In("motion/prior.arrow")],
    output: Annotated[Path, Out("folder of masks frame_0001.png, 255 = dynamic, full resolution, and masks.json")],
    figure: Annotated[Path, Out("picture for the report: frames with their masks")],
    options: SegmentOptions,
) -> None:
    """Refine the motion prior to binary dynamic masks.

    The prior is voted on along the flow, spread up to the colour edges of the frame, and cut by hysteresis. A mask may
    be empty. A frame that would be masked beyond --max-share keeps its surest part; masks.json and the log name it.
    """
    frames = read_sequence(sequence)
    pairs, probability = read_dense(flow), read_dense(prior)["probability"]
    edges = {(int(i), int(j)): e for e, (i, j) in enumerate(zip(pairs["source"], pairs["target"], strict=True))}
    voted = vote(probability, edges, pairs["flow"], pairs["confidence"])
    shares, guarded = {}, []
    shown, overlays = set(figures.spread(len(voted), 6).tolist()), []
    with atomic_folder(output) as folder:
        for k, (path, number) in enumerate(zip(frames.frames, frames.numbers, strict=True)):
            rgb = read_rgb(path)
            mask, was_guarded = _mask(voted[k], rgb, options)
            write_image(folder / f"frame_{number:04d}.png", mask)
            shares[number] = float(mask.mean())
            guarded += [number] if was_guarded else []
            overlays += [figures.overlay_mask(rgb, mask)] if k in shown else []
        write_json(
            folder / "masks.json", {"dynamic_share": shares, "guarded": guarded, "options": options.model_dump()}
        )
    _tell(frames, shares, guarded, options)
    write_figure(figure, figures.contact_sheet(overlays, columns=3))


def _mask(probability: np.ndarray, rgb: np.ndarray, options: SegmentOptions) -> tuple[np.ndarray, bool]:
    """Mask [H, W] of one frame, and whether the guard cut it back."""
    smoothed = smooth_along_edges(probability, rgb, options.smoothness, options.colour_sigma)
    high, low = guarded_thresholds(smoothed, options.high, options.low, options.max_share)
    return to_mask(smoothed, high, low, options.min_area), low > options.low


def _tell(frames: Sequence, shares: dict[int, float], guarded: list[int], options: SegmentOptions) -> None:
    """Log the shares; warn of guarded frames."""
    logger.info("%s: %.1f %% of the pixels are dynamic", frames.name, 100 * float(np.mean(list(shares.values()))))
    if guarded:
        text = "%s: masks of frames %s were cut back to %.0f %% of the frame, their surest part"
        logger.warning(text, frames.name, guarded, 100 * options.max_share)


if __name__ == "__main__":
    cli.run(main)
