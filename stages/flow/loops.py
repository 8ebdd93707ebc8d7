"""Loops: frames that see a place again, long after the flow between them was lost.

Frames that differ enough, `stations`, are described by VLAD (Jegou et al., CVPR 2010) over words of the clip itself.
Stations that look alike are matched by SIFT, and count as the same place if enough matches spread over the image fit
one epipolar geometry and the pairs of stations beside them match the same things. What moves between neighbouring
frames takes no part. A station that also matches one nearby in time that the flow has left by more than a frame shows
texture that repeats, and no place; so does, alas, each station of a camera that turns round within FAR frames.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stages.flow.edges import LOOPS_PER_FRAME, Edge, path, track_points, tracked
from stages.flow.frames import Images
from stages.flow.matches import Features, features, matched
from stages.flow.similarity import alike, similarity_of
from stages.shared.flow_pairs import REACH
from stages.shared.sampson import sampson_distances
from stages.shared.threads import threaded
from stages.shared.warp import bilinear

FAR = REACH
"""Frames up to this distance are joined by long edges, as long as what they show can be tracked."""
MOVED, LOST, CUT = 0.08, 0.25, 0.05
"""A new station: the median point has moved by MOVED of the frame's longer side since the last one, or LOST of the
points are all that is left of it. Where one step leaves fewer than CUT of them, another shot begins."""
CANDIDATES = 4
"""Stations that are compared with each one, the most similar first."""
MOVING_PX = 2.0
"""Keypoints whose flow is further than this from the epipolar geometry of most pixels belong to movers."""
FITTING_PX, ITERATIONS, PROBABILITY = 2.0, 2000, 0.999
"""MAGSAC: inlier threshold, iterations, confidence."""
MIN_INLIERS, MIN_SHARE = 25, 0.5
"""Of matches to one epipolar geometry."""
CELLS, MIN_CELLS = (6, 4), 7
"""Cells of the image across and down, and in how many of them both frames must have inliers."""
NEIGHBOURS, SAME_PX, MIN_SAME, AGREEING = 3, 4.0, 8, 0.6
"""Loops agree if they lie at most NEIGHBOURS stations apart at both ends, and of at least MIN_SAME points of one that
the flow takes to within SAME_PX of points of the other this share are matched to the same place."""


Carry = Callable[[np.ndarray, int, int], tuple[np.ndarray, np.ndarray]]
"""Points [n, 2] px of one station taken along the flow to another, and which of them [n] could be tracked."""


class Loop(NamedTuple):
    """Two frames, the first one earlier, that show the same place; their matches [n, 2, 2], (first, second) px."""

    pair: Edge
    matches: np.ndarray


def find_loops(
    grey: Images | np.ndarray, flow: Mapping[Edge, np.ndarray], scene: np.ndarray | None = None
) -> list[Loop]:
    """Pairs of frames grey [T, h, w] uint8 more than FAR apart that show the same place, sorted.

    Clips of at most FAR frames have none, and take no time. Otherwise time is linear in the frames, but for one product
    of the descriptors of all stations.

    Args:
        flow: [h, w, 2] px of the edges between near frames, both ways.
        scene: [h, w] bool, false where something is burnt into the frames, which is no place; None: nowhere.
    """
    T = len(grey)
    if T <= FAR + 1:
        return []
    size = grey[0].shape
    at, shots, net = stations(flow, T)
    if at[-1] <= FAR:
        return []
    distances = sorted({abs(i - j) for i, j in flow}, reverse=True)
    seen = threaded(lambda i: _at_rest(_in_scene(features(grey[i]), scene), flow, distances, i), at)
    similarity, far = similarity_of(seen), np.subtract.outer(at, at) > FAR
    away = (np.linalg.norm(net[:, None] - net, axis=2) > size[1]) & ~far & ~far.T
    one_shot = np.equal.outer(shots, shots)

    def same(pairs: Sequence[Edge]) -> dict[Edge, np.ndarray]:
        checked = threaded(lambda pair: verified(matched(seen[pair[0]], seen[pair[1]]), size), pairs)
        return {pair: matches for pair, matches in zip(pairs, checked, strict=True) if matches is not None}

    found = same(alike(similarity, far & one_shot, CANDIDATES))
    repeated = {k for pair in same(alike(similarity, away & one_shot & _ends(found, len(at)), 1)) for k in pair}

    def carried(points: np.ndarray, k: int, m: int) -> tuple[np.ndarray, np.ndarray]:
        return _carried(points, path(flow, distances, (at[k], at[m])) or [], flow)

    kept = {
        pair: matches
        for pair, matches in found.items()
        if not repeated & set(pair) and _confirmed(pair, found, carried)
    }
    return sorted((Loop((at[a], at[b]), matches) for (a, b), matches in _few(kept)), key=lambda loop: loop.pair)


def stations(flow: Mapping[Edge, np.ndarray], T: int) -> tuple[list[int], list[int], np.ndarray]:
    """Frames that differ enough from the one before in the list; the shot that each belongs to, 0, 1, ....

    A camera at rest has one station, however much it shakes. Also how far [n, 2] px the median point moved until then,
    all steps added.
    """
    at, shots, net, total = [0], [0], [np.zeros(2)], np.zeros(2)
    start = points = track_points(*flow[0, 1].shape[:2])
    far_px, all_points = MOVED * max(flow[0, 1].shape[:2]), len(points)
    for i in range(T - 1):
        moved, kept = tracked(points, flow[i, i + 1], flow[i + 1, i])
        cut = kept.sum() < CUT * len(points)
        if kept.any():
            total = total + np.median(moved[kept] - points[kept], axis=0)
        start, points = start[kept], moved[kept]
        lost = len(points) < LOST * all_points
        if cut or lost or np.median(np.linalg.norm(points - start, axis=1)) > far_px:
            at.append(i + 1)
            shots.append(shots[-1] + int(cut))
            net.append(total)
            start = points = track_points(*flow[0, 1].shape[:2])
    return at, shots, np.array(net)


def verified(matches: np.ndarray, size: tuple[int, ...]) -> np.ndarray | None:
    """The inliers [m, 2, 2] of matches [n, 2, 2] px to one epipolar geometry; None if too few, or in one corner.

    Args:
        size: (height, width) of the frames, px.
    """
    if len(matches) < MIN_INLIERS:
        return None
    fitting = _epipolar(matches)[1]
    inliers = matches[fitting]
    if len(inliers) < max(MIN_INLIERS, MIN_SHARE * len(matches)):
        return None
    cells = (inliers * CELLS / size[::-1]).astype(int) @ (1, CELLS[0])
    return inliers if min(len(np.unique(of)) for of in cells.T) >= MIN_CELLS else None


def _epipolar(matches: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Fundamental matrix [3, 3] of matches [n, 2, 2] px, None without one, and which of them [n] fit it."""
    here, there = np.ascontiguousarray(matches[:, 0]), np.ascontiguousarray(matches[:, 1])
    cv2.setRNGSeed(0)
    F, fitting = cv2.findFundamentalMat(here, there, cv2.USAC_MAGSAC, FITTING_PX, PROBABILITY, ITERATIONS)
    if F is None or F.shape != (3, 3):
        return None, np.zeros(len(matches), bool)
    return F, fitting[:, 0] > 0


def _in_scene(found: Features, scene: np.ndarray | None) -> Features:
    """The features of a frame at pixels of the scene [h, w] bool."""
    if scene is None:
        return found
    u, v = np.rint(found[0]).astype(int).T
    shown = scene[np.clip(v, 0, scene.shape[0] - 1), np.clip(u, 0, scene.shape[1] - 1)]
    return found[0][shown], found[1][shown]


def _at_rest(found: Features, flow: Mapping[Edge, np.ndarray], distances: Sequence[int], i: int) -> Features:
    """The features of frame i without those on movers, by the flow of its longest near edge."""
    points, descriptors = found
    j = next(j for distance in distances for j in (i + distance, i - distance) if (i, j) in flow)
    grid = track_points(*flow[i, j].shape[:2])
    moved, kept = tracked(grid, flow[i, j], flow[j, i])
    if kept.sum() < MIN_INLIERS or not len(points):
        return found
    F, _ = _epipolar(np.stack([grid[kept], moved[kept]], axis=1))
    if F is None:
        return found
    away = sampson_distances(F, points.astype(float), points + bilinear(flow[i, j], points).astype(float))
    still = np.abs(away) < MOVING_PX
    return points[still], descriptors[still]


def _ends(found: Mapping[Edge, np.ndarray], n: int) -> np.ndarray:
    """[n, 1] which of n stations are ends of a pair."""
    ends = np.zeros((n, 1), bool)
    ends[[k for pair in found for k in pair]] = True
    return ends


def _confirmed(pair: Edge, found: Mapping[Edge, np.ndarray], carried: Carry) -> bool:
    """Whether a pair of stations beside this one has matched the same things."""
    near = [step for step in range(-NEIGHBOURS, NEIGHBOURS + 1) if step]
    others = ((pair[0] + p, pair[1] + q) for p, q in itertools.product(near, near))
    return any(_agree(pair, other, found, carried) for other in others if other in found)


def _agree(pair: Edge, other: Edge, found: Mapping[Edge, np.ndarray], carried: Carry) -> bool:
    """Whether matches of one pair, taken along the flow to another pair of stations, are matches of that one too."""
    (first, kept), (second, also) = (carried(found[pair][:, n], pair[n], other[n]) for n in (0, 1))
    here, there = np.stack([first, second], axis=1)[kept & also], found[other]
    if len(here) < MIN_SAME:
        return False
    apart = np.linalg.norm(here[:, None, 0] - there[None, :, 0], axis=2)
    nearest = apart.argmin(axis=1)
    same = apart[np.arange(len(here)), nearest] < SAME_PX
    offsets = here[same] - there[nearest[same]]
    fits = np.linalg.norm(offsets[:, 0] - offsets[:, 1], axis=1) < SAME_PX
    return bool(same.sum() >= MIN_SAME and fits.mean() >= AGREEING)


def _carried(
    points: np.ndarray, hops: Sequence[Edge], flow: Mapping[Edge, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 2] px taken along the edges `hops`, and which of them [n] could be tracked all the way."""
    kept = np.ones(len(points), bool)
    for hop in hops:
        points, found = tracked(points, flow[hop], flow[hop[::-1]])
        kept &= found
    return points, kept


def _few(found: Mapping[Edge, np.ndarray]) -> Iterator[tuple[Edge, np.ndarray]]:
    """The pairs of stations, those with most matches first, while both stations have fewer than LOOPS_PER_FRAME."""
    count: dict[int, int] = {}
    for pair in sorted(found, key=lambda pair: (-len(found[pair]), pair)):
        if all(count.get(k, 0) < LOOPS_PER_FRAME for k in pair):
            count |= {k: count.get(k, 0) + 1 for k in pair}
            yield pair, found[pair]
