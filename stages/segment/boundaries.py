"""Boundaries of masks on pixels: along the edges of a frame, by the colours of it and of others, by a network."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np

from stages.segment.colours import ASKED_PX, Learnt, border_distance, colour_evidence, learn
from stages.segment.network import Network, correct
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC
from stages.segment.refined import Known
from stages.segment.refinement import guarded_threshold, smooth_along_edges, to_mask
from stages.shared.images import REFERENCE_PX, enlarge, reduce, reduced_size, relative_size

TEACHING = -6, -3, 3, 6
"""Distances in frames of those whose colours count too: what is lost, or masked by mistake, in one is not in all."""

BORDER_PX = 6.0
"""Distance from the border of a mask, in frames of REFERENCE_PX, within which the network is told how far it is."""
LEVELS = 32.0
"""Colour levels (CIELAB, 0..255) that count as 1, from the middle ones on."""


class Bounded(NamedTuple):
    """A frame, and how surely its pixels move by what follows the edges and the colours.

    Attributes:
        rgb: [H, W, 3] uint8. first: [H, W] without, sureness: with what colours say [H, W], -1..1, 0 where none are
            asked. threshold: of its mask; above DYNAMIC if it is cut back.
    """

    rgb: np.ndarray
    known: Known
    first: np.ndarray
    colours: np.ndarray
    sureness: np.ndarray
    threshold: float


def masks_on_pixels(
    T: int,
    picture: Callable[[int], np.ndarray],
    known: Callable[[int], Known],
    options: SegmentOptions,
    network: Network | None = None,
) -> Iterator[tuple[np.ndarray, bool]]:
    """The mask [H, W] bool of each of T frames in turn, and whether it was cut back, as it would be nearly full.

    Args:
        picture: gives frame k [H, W, 3] uint8, once. known: gives what is known of its pixels.
        network: decides near borders, where the pictures were asked.
    """
    for frame in bounded(T, picture, known, options):
        sureness, threshold = frame.sureness, frame.threshold
        if network and frame.known.evidence is not None and threshold == DYNAMIC:
            sureness = correct(network, maps_of(frame), near_border(frame), sureness)
            threshold = guarded_threshold(sureness, DYNAMIC, options.max_share)
        yield to_mask(sureness, threshold, options.min_area), threshold > DYNAMIC


def bounded(
    T: int, picture: Callable[[int], np.ndarray], known: Callable[[int], Known], options: SegmentOptions
) -> Iterator[Bounded]:
    """Each of T frames in turn, with how surely its pixels move; arguments as of `masks_on_pixels`."""
    taught: dict[int, Learnt | None] = {}
    ahead: dict[int, Bounded] = {}
    for k in range(T):
        for j in range(max(ahead, default=-1) + 1, min(k + max(TEACHING) + 1, T)):
            ahead[j] = _along_edges(picture(j), known(j), options)
            taught[j] = learn(ahead[j].first, ahead[j].rgb) if ahead[j].threshold == DYNAMIC else None
        frame = ahead.pop(k)
        if own := taught[k]:  # else its surest part is wanted, and not that of the clearest colours
            others = [learnt for step in TEACHING if (learnt := taught.get(k + step))]
            frame = _by_colours(frame, colour_evidence(frame.first, frame.rgb, own, others), options)
        taught.pop(k + min(TEACHING), None)
        yield frame


def near_border(frame: Bounded) -> np.ndarray:
    """Pixels [H, W] bool of which colours, and the network, are asked."""
    return np.asarray(np.abs(border_distance(frame.first)) <= ASKED_PX * relative_size(frame.rgb))


def maps_of(frame: Bounded) -> np.ndarray:
    """What the network is told [n, h, w] float32, all of it of the order of 1: what is known, and the colours.

    Of frames whose longer side is above REFERENCE_PX, reduced to that: it has learnt from such.
    """
    sure, shown, evidence = frame.known
    assert shown is not None
    assert evidence is not None
    H, W = frame.first.shape
    size = reduced_size(W, H, REFERENCE_PX)
    distance = np.tanh(border_distance(frame.first) / (BORDER_PX * relative_size(frame.rgb)))
    on_pixels = 2 * frame.sureness - 1, 2 * frame.first - 1, frame.colours, distance
    on_grid = 2 * sure - 1, shown, *(2 * evidence - 1)
    lab = cv2.cvtColor(reduce(frame.rgb, size), cv2.COLOR_RGB2LAB).astype(np.float32) / LEVELS - 128 / LEVELS
    maps = np.empty((len(on_pixels) + len(on_grid) + 3, *size[::-1]), np.float32)
    for k, of in enumerate((*on_pixels, *on_grid)):
        maps[k] = _at(of.astype(np.float32, copy=False), size)
    maps[-3:] = np.moveaxis(lab, -1, 0)
    return maps


def _at(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image [h, w] float32 of the frame, reduced or enlarged to another of its reduced sizes (w, h).

    What is reduced twice may lack a row, which repeats the last one.
    """
    if image.shape[1] < size[0]:
        return enlarge(image, size)
    found = reduce(image, size)
    return np.asarray(cv2.copyMakeBorder(found, 0, size[1] - len(found), 0, 0, cv2.BORDER_REPLICATE))


def _along_edges(rgb: np.ndarray, known: Known, options: SegmentOptions) -> Bounded:
    first = smooth_along_edges(known.sure, rgb, options.smoothness, options.colour_sigma, known.shown)
    threshold = guarded_threshold(first, DYNAMIC, options.max_share)
    return Bounded(rgb, known, first, np.zeros_like(first), first, threshold)


def _by_colours(frame: Bounded, colours: np.ndarray, options: SegmentOptions) -> Bounded:
    sure, shown = frame.known[:2]
    sureness = smooth_along_edges(sure, frame.rgb, options.smoothness, options.colour_sigma, shown, colours)
    threshold = guarded_threshold(sureness, DYNAMIC, options.max_share)
    return frame._replace(colours=colours, sureness=sureness, threshold=threshold)
