"""Labels that belong to things over the whole clip: one sparse linear system over the superpixels of all frames.

Unknown x_a in 0..1: how much superpixel a belongs to something that moves in the clip. It minimises

    sum_a c_a (x_a - p_a)^2 + sum_ab W_ab (x_a - x_b)^2

with the prior p, its weight c and links W along the flow and across borders, all smaller where colours differ. Evidence
of motion is one-sided: a residual to the static world says "moves", none says little (at rest just now, along the
epipolar line, blurred). Hence c is large where p is high. Masks m that the user gives as evidence add another term,
s_a (x_a - m_a)^2, and so does what the pictures show (`layers`). The idea of labels by consensus over a clip is that of
Faktor and Irani (Video segmentation by non-local consensus voting, BMVC 2014).
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from stages.segment.superpixels import Superpixels, borders, matches
from stages.shared.images import relative_size
from stages.shared.log import logger

DYNAMIC = 0.5
"""Sureness from which on a superpixel, or a pixel, is dynamic."""
LOW_WEIGHT, LEAST_WEIGHT = 0.2, 1e-3
"""Weight of evidence that nothing moves, relative to that of certain motion; weight of a pixel without any evidence."""
STATED_MOVING, STATED_STATIC = 1.0, 0.3
"""Weight of a pixel that the user's masks call moving, as of certain motion, and of one that they call static.

If both were 1, movers that such masks miss would be lost: with empty masks the demo has an IoU of 0.88, and then 0.
By masks of every other frame that of three scenes rises from 0.88, 0.56 and 0.66 to 0.89, 0.76 and 0.96."""
HALF_WEIGHT = 1.0
"""Summed weight of the flow at which evidence counts half."""
BORDER_WEIGHT = 2.4
"""Of a pixel of shared border in frames of REFERENCE_PX; a pixel of evidence weighs 1."""
MATCH_COLOUR, BORDER_COLOUR = 20.0, 8.0
"""Standard deviation of colour differences (CIELAB, 0..255) along the flow and across borders."""
WINDOW, OVERLAP = 100, 25
"""Frames that are solved together, and how many two windows share: the system does not grow with the clip."""
TOLERANCE, MAX_ITERATIONS = 1e-3, 300
SPREADING = 20
"""Steps in which the level of a mover spreads over its surroundings."""
LEVEL_POWER = 4
"""The larger, the more the largest values decide on the level."""
RELATIVE = 0.6
"""A superpixel is dynamic from this share of the level of its surroundings on: weak and strong evidence alike end about
halfway between a mover and what is behind it."""
MIN_STRENGTH, MIN_SUPPORT = 1.3, 0.15
"""Least mean x of an instance, in thresholds (at most halfway from the threshold to 1), and least mean of x times the
share by which it counts. Flow fails at occlusions and on textureless sky; what shows there is weak, or unsure, in every
frame of it."""
CANDIDATE = 0.95, 0.8
"""Shares of both that are enough for an instance to be asked about, and for one that the pictures show to move."""
CONFIRMED, EVIDENT = 0.03, 1.25
"""Least mean weight with which they show then that it moves, over what was compared of it (of at most
`stages.segment.layers.MOVING`); what is so many times as strong as it needs to be is kept without."""


def confidence_of(weight: np.ndarray) -> np.ndarray:
    """Share 0..1 by which evidence counts whose flow has this summed weight, of any shape."""
    return np.asarray(weight / (weight + HALF_WEIGHT))


def link_weights(
    pixels: Superpixels, pairs: Mapping[str, np.ndarray], start: int, permanence: float
) -> sparse.csr_matrix:
    """W [N, N] of the superpixels of the frames from `start` on; `permanence` weighs links along the flow.

    With the size of the frames, areas grow with its square and borders with itself: hence the factor.
    """
    along = permanence * _alike(matches(pixels, pairs, start), pixels.colours, MATCH_COLOUR)
    border = BORDER_WEIGHT * relative_size(pixels.labels[0])
    return along + border * _alike(borders(pixels), pixels.colours, BORDER_COLOUR)


class Links:
    """The superpixels of a clip and W between those of a window, which is kept where there is but one.

    Arguments as of `link_weights`, of the whole clip.
    """

    def __init__(self, pixels: Superpixels, pairs: Mapping[str, np.ndarray], permanence: float) -> None:
        self.pixels = pixels
        kept = len(list(windows(len(pixels.labels)))) == 1
        self.within = lru_cache(int(kept))(
            lambda start, stop: link_weights(pixels.part(start, stop), pairs, start, permanence)
        )


def solve(
    W: sparse.csr_matrix,
    areas: np.ndarray,
    prior: np.ndarray,
    confidence: np.ndarray,
    stated: np.ndarray | None = None,
    shown: np.ndarray | None = None,
) -> np.ndarray:
    """x [N] of superpixels with links W [N, N], areas [N] px, priors [N] 0..1 and their confidence [N] 0..1.

    `stated` is the share [N] of each that masks of the user's mark: another term s_a (x_a - m_a)^2 beside the prior's.
    `shown` [N] is the weight with which pictures say that each moves, or, negative, rests: such a term with m_a = 1, 0.
    Conjugate gradients with the diagonal as preconditioner; the system is positive definite, as every area is positive.
    """
    weight = areas * ((LOW_WEIGHT + (1 - LOW_WEIGHT) * prior) * confidence + LEAST_WEIGHT)
    pull = weight * prior
    if stated is not None:
        said = areas * (STATED_STATIC + (STATED_MOVING - STATED_STATIC) * stated)
        weight, pull = weight + said, pull + said * stated
    if shown is not None:
        weight, pull = weight + areas * np.abs(shown), pull + areas * np.maximum(shown, 0)
    degrees = np.asarray(W.sum(axis=1)).ravel()
    system, inverse = sparse.diags(weight + degrees) - W, sparse.diags(1 / (weight + degrees))
    x, unsolved = cg(system, pull, x0=prior, rtol=TOLERANCE, maxiter=MAX_ITERATIONS, M=inverse)
    if unsolved:
        logger.warning("masks: the system over the clip is not solved after %d iterations", MAX_ITERATIONS)
    return np.asarray(np.clip(x, 0, 1))


def level(W: sparse.csr_matrix, areas: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Level [N] of x around each superpixel: a mean along the links in which large values dominate.

    sum x^(k + 1) / sum x^k over a few steps of diffusion: where a mover is near, the value that it has.
    """
    spreading = W + sparse.diags(0.2 * areas)
    spreading = sparse.diags(1 / np.asarray(spreading.sum(axis=1)).ravel()) @ spreading
    above = np.stack([areas * (x + 1e-3) ** (LEVEL_POWER + 1), areas * (x + 1e-3) ** LEVEL_POWER], axis=1)
    for _ in range(SPREADING):
        above = spreading @ above
    return np.asarray(above[:, 0] / above[:, 1])


def persistent(
    linked: Links,
    prior: np.ndarray,
    confidence: np.ndarray,
    threshold: float,
    stated: np.ndarray | None = None,
    shown: np.ndarray | None = None,
    asked: np.ndarray | None = None,
    candidates: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """How surely each superpixel is dynamic [N], and its instance [N].

    Args:
        prior: [N] probability of motion; confidence: [N] share by which it counts.
        threshold: least x of a dynamic superpixel. stated, shown: [N] as in `solve`.
        asked: [N] share of each of which the pictures could show whether it moves; None: they need not show it.
        candidates: whether instances are kept that the pictures are to be asked about.

    Returns:
        x over twice its threshold, at most 1: from DYNAMIC on dynamic, 0 for what is no part of a kept instance.
        Instances 1, 2, ... from the largest to the smallest, 0 where static. An instance is what is connected in space
        and time.
    """
    pixels, joined = linked.pixels, []
    x, levels = np.zeros((2, len(pixels.areas)))
    for start, stop, taper in windows(len(pixels.labels)):
        nodes, part = slice(pixels.first[start], pixels.first[stop]), pixels.part(start, stop)
        W = linked.within(start, stop)
        more = (None if of is None else of[nodes] for of in (stated, shown))
        found = solve(W, part.areas, prior[nodes], confidence[nodes], *more)
        share = np.repeat(taper, np.diff(part.first))
        x[nodes] += share * found
        levels[nodes] += share * level(W, part.areas, found)
        W = W.tocoo()
        near = (found[W.row] > threshold / 2) & (found[W.col] > threshold / 2) & (W.row < W.col)
        joined.append(pixels.first[start] + np.stack([W.row[near], W.col[near]]))
    sure = x / (2 * np.maximum(threshold, RELATIVE * levels))
    for told in (stated, shown):  # where the flow is unsure, both may say what moves
        confidence = confidence if told is None else np.maximum(confidence, told)
    enough, weaker = (_evidence(x, confidence, threshold, *shares) for shares in ((1.0, 1.0), CANDIDATE))
    grounds: list[tuple[np.ndarray, ...]] = [weaker if candidates else enough]
    if shown is not None and asked is not None:
        evident = x - _least(threshold, EVIDENT)
        grounds = [(*enough, shown - CONFIRMED * asked), (*enough, evident), (*weaker, shown - CONFIRMED)]
    instance = instances(sure >= DYNAMIC, np.concatenate(joined, axis=1), pixels.areas, grounds)
    return np.where((sure >= DYNAMIC) & (instance == 0), 0, np.minimum(sure, 1)), instance


def _least(threshold: float, share: float) -> float:
    """Least mean x of an instance, at a share of what is needed; certain motion is kept at every threshold."""
    return min(share * MIN_STRENGTH * threshold, min(share, 1) * (1 + threshold) / 2)


def _evidence(
    x: np.ndarray, confidence: np.ndarray, threshold: float, strength: float, support: float
) -> tuple[np.ndarray, np.ndarray]:
    """By how much [N] each superpixel has more strength and support than these shares of what an instance needs."""
    return x - _least(threshold, strength), x * confidence - support * MIN_SUPPORT


def instances(
    dynamic: np.ndarray,
    joined: np.ndarray,
    areas: np.ndarray,
    grounds: Sequence[Sequence[np.ndarray]],
) -> np.ndarray:
    """Numbers [N] of connected dynamic superpixels, 1 for the largest; 0 for static ones and for what is too weak.

    Args:
        dynamic: [N] bool; joined: [2, L] pairs of superpixels that are linked. areas: [N] px.
        grounds: each of some [N]; an instance needs a mean of at least 0 of all that belong to one ground.
    """
    inner = joined[:, dynamic[joined[0]] & dynamic[joined[1]]]
    graph = sparse.coo_matrix((np.ones(inner.shape[1]), tuple(inner)), (len(areas), len(areas)))
    component = connected_components(graph, directed=False)[1]
    labels = np.unique(component[dynamic], return_inverse=True)[1]
    sizes = np.bincount(labels, areas[dynamic])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.bincount(labels, (areas * values)[dynamic]) / sizes)

    kept = np.logical_or.reduce([np.logical_and.reduce([mean(of) >= 0 for of in ground]) for ground in grounds])
    order = np.argsort(np.where(kept, -sizes, 0), kind="stable")
    numbers = np.zeros(len(sizes), np.int64)
    numbers[order[: kept.sum()]] = np.arange(1, kept.sum() + 1)
    result = np.zeros(len(areas), np.int64)
    result[dynamic] = numbers[labels]
    return result


def windows(T: int) -> Iterator[tuple[int, int, np.ndarray]]:
    """First and last frame of the windows over T frames, and weights [stop - start] that blend where two overlap."""
    starts = list(range(0, max(T - OVERLAP, 1), WINDOW - OVERLAP))
    for start in starts:
        stop = min(start + WINDOW, T)
        taper = np.ones(stop - start)
        ramp = (np.arange(OVERLAP) + 1) / (OVERLAP + 1)
        if start > 0:
            taper[:OVERLAP] = ramp[: len(taper)]
        if stop < T:
            taper[-OVERLAP:] = ramp[::-1]
        yield start, stop, taper


def _alike(weights: sparse.csr_matrix, colours: np.ndarray, sigma: float) -> sparse.csr_matrix:
    """Link weights [N, N] times a Gaussian of the difference of the colours [N, 3] that they link."""
    found = weights.tocoo()
    squared = np.zeros(found.nnz, np.float32)
    for channel in colours.T.astype(np.float32):  # one by one: all at once would be most of the memory of a window
        squared += (channel[found.row] - channel[found.col]) ** 2
    return sparse.csr_matrix((found.data * np.exp(-squared / (2 * sigma**2)), (found.row, found.col)), found.shape)
