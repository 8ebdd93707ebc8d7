"""Does the static world explain the pictures where flow is unreliable?

Flow that failed fits no depth, just as flow of a mover: fog, blur and repeated texture look like motion. The pictures
tell them apart: warped by a static depth they match as well as by the flow, unless something moved.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from stages.flow.epipolar import Evidence
from stages.flow.pooling import POOLED_OFFSETS
from stages.flow.resweep import rigid_flow
from stages.shared.threads import threaded
from stages.shared.warp import is_inside, warp

RELIABLE = 0.25
"""Mean confidence over its edges from which on a pixel's flow speaks for itself."""
EXCESS = 0.25
"""Excess of the static world's residual over the flow's, in medians of the latter, that counts by half."""
LEAST_NOISE = 0.5
"""Grey levels: 8-bit frames resolve no less."""
WINDOW_PX = 5


def corroborate(
    evidence: Evidence,
    grey: np.ndarray,
    pairs: Mapping[str, np.ndarray],
    projections: tuple[np.ndarray, np.ndarray],
    inverse_depth: np.ndarray,
) -> Evidence:
    """Evidence with the misfit of unreliable flow cut to what the pictures confirm.

    Args:
        evidence: misfit [T, h, w] to the static world, and its weight.
        grey: [T, h, w] uint8 frames on the flow grid.
        pairs: source, target [E], flow [E, h, w, 2] px, confidence [E, h, w].
        projections: A [E, 3, 3] and b [E, 3] of `resweep`; inverse_depth: [T, h, w] in the units of b.
    """
    leaving = [pairs["confidence"][pairs["source"] == i] for i in range(len(grey))]
    reliability = np.stack([edges.sum(axis=0, dtype=np.float32) / max(len(edges), 1) for edges in leaving])
    confirmed = _confirmed(grey, pairs, projections, inverse_depth)
    return evidence._replace(misfit=evidence.misfit * np.maximum(np.minimum(reliability / RELIABLE, 1), confirmed))


def _confirmed(
    grey: np.ndarray,
    pairs: Mapping[str, np.ndarray],
    projections: tuple[np.ndarray, np.ndarray],
    inverse_depth: np.ndarray,
) -> np.ndarray:
    """How clearly [T, h, w], 0..1, the flow matches the pictures better than the static world; 1 if unseen."""
    frames = np.stack([cv2.GaussianBlur(frame.astype(np.float32), (0, 0), 0.7) for frame in grey])

    def of_frame(i: int) -> np.ndarray:
        """Sums of residuals [2, h, w] after the static flow and after the flow, and the number of edges [h, w]."""
        static, flowing, seen = np.zeros((3, *frames.shape[1:]), np.float32)
        d = inverse_depth[i].astype(np.float32)
        depths = d, cv2.medianBlur(d, WINDOW_PX)
        for e in np.flatnonzero(pairs["source"] == i):
            j = pairs["target"][e]
            if abs(i - int(j)) not in POOLED_OFFSETS:
                continue
            flow = pairs["flow"][e].astype(np.float32, copy=False)
            rigid = [rigid_flow(projections[0][e], projections[1][e], d) for d in depths]
            inside = is_inside(flow) & is_inside(rigid[0]) & is_inside(rigid[1])
            difference = warp(frames[j], flow) - frames[i]
            exposure = np.float32(np.median(difference))
            flowing += inside * _blurred(difference - exposure)
            residuals = [_blurred(warp(frames[j], way) - frames[i] - exposure) for way in rigid]
            static += inside * np.minimum(*residuals)
            seen += inside
        return np.stack([static, flowing, seen])

    static, flowing, seen = np.stack(threaded(of_frame, range(len(frames))), axis=1)
    scale = np.maximum(seen, 1)
    noise = max(float(np.median(flowing / scale)), LEAST_NOISE)
    squared = (np.maximum(static - flowing, 0) / (scale * EXCESS * noise)) ** 2
    return np.where(seen > 0, squared / (1 + squared), 1)


def _blurred(difference: np.ndarray) -> np.ndarray:
    """Mean absolute difference in a small window."""
    return np.asarray(cv2.blur(np.abs(difference), (WINDOW_PX, WINDOW_PX)))
