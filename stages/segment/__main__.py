"""Refine the motion prior to binary dynamic masks at full resolution, and number what moves."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from stages.given import masks as given_masks
from stages.given.files import of_sequence
from stages.given.masks import GivenMasks
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC
from stages.segment.refined import evidence_of_clip, refined
from stages.shared import cli, drawing
from stages.shared.artifacts import read_dense, read_json, write_json
from stages.shared.atomic import atomic_folder, copy, copy_folder
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.images import enlarge, read_mask, read_rgb, write_figure, write_image
from stages.shared.log import logger, progress
from stages.shared.masks import instances_path, mask_path, read_burnt_in
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.settled import Solved, results_to_keep


class Mask(NamedTuple):
    """Dynamic pixels [H, W] bool of a frame, their instances [H, W] uint16, and whether the guard cut it back."""

    dynamic: np.ndarray
    instances: np.ndarray
    guarded: bool = False


Masks = Iterator[Mask]
"""The masks of the frames, in their order."""
WRITES = ("frame_*.png", "instances/frame_*.png", "masks.json")
"""Files of a folder of masks."""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    output: Annotated[Path, Out("folder of masks frame_0001.png, 255 = dynamic, of instances, masks.json")],
    figure: Annotated[Path, Out("picture for the report: frames with their masks, coloured by instance")],
    options: SegmentOptions,
    flow: Annotated[Path | None, In("flow/pairs.arrow, for refined masks")] = None,
    prior: Annotated[Path | None, In("motion/prior.arrow, for refined masks and the prior as mask")] = None,
    previous_poses: Annotated[Path | None, In("poses.parquet of the round before, for refined masks")] = None,
    previous_depth: Annotated[Path | None, In("depth.arrow of the round before")] = None,
    previous_masks: Annotated[Path | None, In("masks of the round before")] = None,
    previous_figure: Annotated[Path | None, In("picture of the round before")] = None,
    earlier_poses: Annotated[Path | None, In("poses.parquet that the round before began with")] = None,
    earlier_depth: Annotated[Path | None, In("depth.arrow that the round before began with")] = None,
) -> str:
    """Refine the motion prior to binary dynamic masks, or take over masks that are given.

    One system over the superpixels of all frames decides what belongs to something that moves in the clip. With the
    cameras of the round before it is solved again, with what the pictures give to movers and to the static scene. Its
    borders then follow the colour edges of each frame, and what colours near by are inside and outside of them. A mask
    may be empty. A frame that would be masked beyond --max-share keeps its surest part; masks.json and the log name it.
    What is connected over space and time has one number through the clip, in instances/frame_0001.png (16 bit, 0 =
    static). If the round before began with the same cameras, its masks are carried over. Other sources write the masks
    that refinement is compared with, as one instance, or those of the user as they are.
    """
    frames = read_sequence(sequence)
    begun = Solved(previous_poses, previous_depth), Solved(earlier_poses, earlier_depth)
    if kept := results_to_keep(*begun, (previous_masks, previous_figure), flow):
        copy_folder(kept[0], output, WRITES)
        copy(kept[1], figure)
        return f"cameras unchanged: {_tell(frames, read_json(output / 'masks.json'), options)}"
    handed, burnt_in = _handed_in(options.given, frames), read_burnt_in(frames)
    if options.evidence and options.source != "refined":
        logger.warning("%s: masks as evidence are not used by `source: %s`", frames.name, options.source)
    masks = _given(handed) if handed else _masks(options, frames, flow, prior, begun[0])
    found, shown, overlays = _Facts(), set(drawing.spread(len(frames.numbers), 6).tolist()), []
    with atomic_folder(output, WRITES) as folder:
        for k, number in progress(list(enumerate(frames.numbers)), "masks"):
            mask = next(masks) if burnt_in is None else _without(burnt_in, next(masks))
            write_image(mask_path(folder, number), mask.dynamic)
            write_image(instances_path(folder, number), mask.instances)
            found.add(number, mask)
            overlays += [drawing.overlay_instances(read_rgb(frames.frames[k]), mask.instances)] if k in shown else []
        facts = found.to_json() | ({"given": handed.kind} if handed else {})
        write_json(folder / "masks.json", facts | {"options": options.model_dump()})
    write_figure(figure, drawing.contact_sheet(overlays, columns=3))
    return _tell(frames, facts, options)


class _Facts:
    """What masks.json says of the masks: shares of the frames, frames that were cut back, and the instances."""

    def __init__(self) -> None:
        self.shares: dict[int, float] = {}
        self.guarded: list[int] = []
        self.pixels: dict[int, Counter[int]] = {}

    def add(self, number: int, mask: Mask) -> None:
        """Take in the mask of the frame with this number."""
        self.shares[number] = float(mask.dynamic.mean())
        self.guarded += [number] if mask.guarded else []
        for instance, pixels in zip(*np.unique(mask.instances, return_counts=True), strict=True):
            if instance > 0:
                self.pixels.setdefault(int(instance), Counter())[number] = int(pixels)

    def to_json(self) -> dict[str, Any]:
        """The facts, with the frames in which each instance is seen and its mean pixels there."""
        seen = {
            number: {"first_frame": min(of), "last_frame": max(of), "frames": len(of), "pixels": of.total() / len(of)}
            for number, of in sorted(self.pixels.items())
        }
        return {"dynamic_share": self.shares, "guarded": self.guarded, "instances": seen}


def _masks(options: SegmentOptions, frames: Sequence, flow: Path | None, prior: Path | None, previous: Solved) -> Masks:
    """The masks of the frames, for the chosen source: each is made when it is asked for."""
    size = frames.width, frames.height
    if options.source == "truth":
        return _true(frames)
    if options.source == "none":
        return (_as_one(np.zeros(size[::-1], bool)) for _ in frames.numbers)
    if prior is None or flow is None:
        raise InputError("--flow, --prior", f"both for `source: {options.source}`", "not both", "give both")
    if options.source == "refined":
        handed = _handed_in(options.evidence, frames, "segment.evidence")
        found = evidence_of_clip(options, frames, flow, prior, previous, handed)
        return (Mask(*of) for of in refined(options, frames, found))
    probability = read_dense(prior)["probability"]
    return (_as_one(enlarge(probability[k].astype(np.float32), size) > DYNAMIC) for k in range(len(probability)))


def _handed_in(path: str | None, frames: Sequence, option: str = given_masks.OPTION) -> GivenMasks | None:
    """The masks in the folder that the user names by an option, checked; None if there is none."""
    if path is None:
        return None
    folder = of_sequence(path, frames.name)
    handed = given_masks.read(given_masks.find_masks(folder, frames, option), frames)
    logger.info("%s: masks of %s (%s), %.1f %% of the pixels", frames.name, folder, handed.kind, 100 * handed.share)
    return handed


def _given(handed: GivenMasks) -> Masks:
    return (Mask(labels > 0, labels) for labels in map(handed.labels, range(len(handed.paths))))


def _true(frames: Sequence) -> Masks:
    if not frames.has_truth("motion_mask"):
        expected = "motion_mask beside them, for every frame, for `source: truth`"
        raise InputError(frames.frames[0].parent, expected, "no motion_mask", "set `source: refined`")
    return (_as_one(read_mask(frames.truth["motion_mask"][number])) for number in frames.numbers)


def _without(burnt_in: np.ndarray, mask: Mask) -> Mask:
    """A mask without what is burnt in, [H, W] bool: a logo does not move in the world."""
    return Mask(mask.dynamic & ~burnt_in, np.where(burnt_in, 0, mask.instances).astype(np.uint16), mask.guarded)


def _as_one(dynamic: np.ndarray) -> Mask:
    """A mask [H, W] as one instance."""
    return Mask(dynamic, dynamic.astype(np.uint16))


def _tell(frames: Sequence, facts: dict[str, Any], options: SegmentOptions) -> str:
    """The share of dynamic pixels, in words, by the facts of masks.json; warns of guarded frames."""
    share, count = float(np.mean(list(facts["dynamic_share"].values()))), len(facts["instances"])
    logger.info("%s: %.1f %% of the pixels are dynamic, in %d instances", frames.name, 100 * share, count)
    if facts["guarded"]:
        text = "%s: masks of frames %s were cut back to %.0f %% of the frame, their surest part"
        logger.warning(text, frames.name, facts["guarded"], 100 * options.max_share)
    return f"{share:.1%} of the pixels dynamic"


if __name__ == "__main__":
    cli.run(main)
