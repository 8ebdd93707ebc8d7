"""Refined masks: what the flow, the pictures and the cameras of the round before say together of a clip."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.given.masks import GivenMasks
from stages.segment.options import SegmentOptions
from stages.segment.permanence import Links, confidence_of, persistent
from stages.segment.refinement import to_instances
from stages.segment.static_world import MOTION_AGAIN, static_world
from stages.segment.superpixels import AT_ONCE, Superpixels, superpixels
from stages.shared import drawing
from stages.shared.artifacts import Dense, read_dense
from stages.shared.errors import InputError
from stages.shared.flow_pairs import FlowPairs
from stages.shared.image_noise import blur_of_noise, smoothed
from stages.shared.images import read_rgb, reduce
from stages.shared.masks import read_scene_on_grid
from stages.shared.sequences import Sequence
from stages.shared.settled import Solved


class Known(NamedTuple):
    """What is known of the pixels of a frame on the flow grid.

    Attributes:
        sure: [h, w] how surely each moves, 0..1. shown: [h, w] what pictures show of it, in -1..1, if known.
        evidence: [n, h, w] in 0..1, what the network reads beside, if known.
    """

    sure: np.ndarray
    shown: np.ndarray | None = None
    evidence: np.ndarray | None = None


class ClipEvidence(NamedTuple):
    """What is known of a clip, before borders are found on pixels.

    Attributes:
        pixels: its superpixels. instance: [N] of each, 0 where static. known: gives what is known of frame k.
    """

    pixels: Superpixels
    instance: np.ndarray
    known: Callable[[int], Known]


def refined(
    options: SegmentOptions, frames: Sequence, found: ClipEvidence
) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Mask [H, W] bool, instances [H, W] uint16 of each frame in turn, and whether it was cut back."""
    from stages.segment.boundaries import masks_on_pixels  # compiled code, which masks from elsewhere spare
    from stages.segment.network import read_network

    network = read_network() if options.borders == "learned" else None
    masks = masks_on_pixels(len(frames.frames), lambda k: read_rgb(frames.frames[k]), found.known, options, network)
    for k, (mask, guarded) in enumerate(masks):
        yield mask, to_instances(mask, found.pixels.paint(found.instance, k)), guarded


def evidence_of_clip(
    options: SegmentOptions, frames: Sequence, flow: Path, prior: Path, previous: Solved, handed: GivenMasks | None
) -> ClipEvidence:
    """What is known of a clip.

    Args:
        flow: pairs.arrow. prior: prior.arrow. previous: cameras and depth of the round before, if any.
        handed: masks of the user that are evidence.

    Raises:
        InputError: if the prior has other columns or frames.
    """
    evidence = read_dense(prior)
    if "weight" not in evidence or len(evidence["weight"]) != len(frames.frames):
        expected = f"columns 'probability' and 'weight' of {len(frames.frames)} frames"
        raise InputError(prior, expected, f"columns {sorted(evidence)}", MOTION_AGAIN)
    size = evidence["probability"].shape[:0:-1]
    picture = _picture(frames, size)
    pixels, stated = superpixels(len(frames.frames), picture), None
    if handed:
        marked = (reduce((handed.labels(k) > 0).astype(np.float32), size) for k in range(len(frames.frames)))
        stated = pixels.means(marked)
    probability, weight = (pixels.means(_one_by_one(evidence, name)) for name in ("probability", "weight"))
    matched = read_dense(flow)
    given = Links(pixels, matched, options.permanence), probability, confidence_of(weight), options.threshold, stated
    world = static_world(frames, evidence, prior, flow, *previous)
    sure, instance = persistent(*given, candidates=world is not None)
    if world is None or not instance.any():
        return ClipEvidence(pixels, instance, lambda k: Known(pixels.paint(sure, k)))
    from stages.segment.floating import floating  # compiled code, which clips without cameras spare
    from stages.segment.layers import MOVING, belonging

    pairs = FlowPairs(matched, scene=read_scene_on_grid(frames, size))
    shown = belonging(pixels, pairs, picture, world, sure, options.borders == "learned")
    sure, instance = persistent(*given, shown.weight, shown.asked)
    if (floats := floating(given[0], world, sure)).any():  # beside what the pictures have confirmed
        moving = np.where(floats, np.maximum(shown.weight, MOVING), shown.weight)
        sure, instance = persistent(*given, moving, shown.asked)

    def known(k: int) -> Known:
        if k % AT_ONCE == 0:
            evidence.release()
        sure_here, in_parts = pixels.paint(sure, k), shown.in_parts(k)
        if in_parts is None:
            return Known(sure_here, shown.of_frame(k))
        of_flow = evidence["probability"][k], confidence_of(evidence["weight"][k].astype(np.float32))
        return Known(sure_here, shown.of_frame(k), np.concatenate([in_parts, of_flow]))

    return ClipEvidence(pixels, instance, known)


def _picture(frames: Sequence, size: tuple[int, int]) -> Callable[[int], np.ndarray]:
    """Gives frame k [h, w, 3] uint8 on the flow grid of this size (w, h), smoothed as far as the clip is noisy."""

    def raw(k: int) -> np.ndarray:
        return reduce(read_rgb(frames.frames[k]), size)

    blur_px = float(np.median([blur_of_noise(raw(int(k))) for k in drawing.spread(len(frames.frames), 3)]))
    return lambda k: smoothed(raw(k), blur_px)


def _one_by_one(columns: Dense, name: str) -> Iterator[np.ndarray]:
    """The rows of a column, whose memory is given back now and then."""
    for k in range(len(columns[name])):
        yield columns[name][k]
        if k % AT_ONCE == 0:
            columns.release()
