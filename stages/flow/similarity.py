"""How alike the places look that frames show: VLAD (Jegou et al., CVPR 2010) over words of the clip itself."""

from collections.abc import Sequence

import cv2
import numpy as np

from stages.flow.edges import Edge
from stages.flow.matches import Features

WORDS, SAMPLES = 32, 12000
"""Of the vocabulary, and the descriptors that it is made from."""


def similarity_of(seen: Sequence[Features]) -> np.ndarray:
    """Cosines [n, n] between VLADs of n frames, the residuals of each word of unit length (Arandjelovic, 2013)."""
    starts = np.cumsum([0, *(len(descriptors) for _, descriptors in seen)])
    if starts[-1] < WORDS:
        return np.zeros((len(seen), len(seen)), np.float32)
    every = max(1, int(starts[-1]) // SAMPLES)
    sample = np.concatenate([of[-start % every :: every] for start, (_, of) in zip(starts, seen, strict=False)])
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, 8, 0.0)
    _, _, words = cv2.kmeans(sample, WORDS, np.zeros(0, np.int32), stop, 1, cv2.KMEANS_PP_CENTERS)
    half = 0.5 * (words**2).sum(axis=1)
    vlad = np.zeros((len(seen), WORDS, 128), np.float32)
    for of, (_, descriptors) in zip(vlad, seen, strict=True):
        nearest = (descriptors @ words.T - half).argmax(axis=1)
        np.add.at(of, nearest, descriptors - words[nearest])
    vlad /= np.maximum(np.linalg.norm(vlad, axis=2, keepdims=True), 1e-9)
    flat = vlad.reshape(len(seen), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    return np.asarray(flat @ flat.T)


def alike(similarity: np.ndarray, allowed: np.ndarray, most: int) -> list[Edge]:
    """For each of n stations b the `most` stations a most similar [n, n] to it of those `allowed` [b, a]: (a, b)."""
    pairs = []
    for b, row in enumerate(allowed):
        others = np.flatnonzero(row)
        best = others[np.argsort(-similarity[b, others], kind="stable")[:most]]
        pairs += [(int(a), b) for a in best]
    return sorted(pairs)
