"""Which instance of the masks a dynamic Gaussian belongs to, so that the viewer can tell movers apart."""

from pathlib import Path

import numpy as np
import torch

from stages.shared.cameras import Cameras, project
from stages.shared.drawing import LONG_CLIP, spread
from stages.shared.masks import read_instances
from stages.shared.sequences import Sequence
from stages.splatting.gaussian_model import GaussianScene

VOTING_FRAMES, VOTING_EVERY = 8, 8
"""Number of frames in which votes are cast, of a long clip one in so many."""
MOST = 255
"""Instances that keep a number: the most frequent ones."""


@torch.no_grad()
def instance_votes(
    scene: GaussianScene, cameras: Cameras, times: np.ndarray, frames: Sequence, masks: Path, chosen: np.ndarray
) -> np.ndarray:
    """The instances [F, D] that the dynamic Gaussians fall on in the `chosen` frames [F]; 0: none, or outside.

    In a long clip those have no vote that are not there at the time: where they would be, something else may move.
    """
    votes, D = [], len(scene.anchors) - scene.n_static
    for k in chosen:
        means = scene.at(float(times[k]))[0][scene.n_static :].double().cpu().numpy()
        uv, depth = project(means, cameras.cam_from_world[k], cameras.Ks[k])
        found = at_pixels(read_instances(masks, frames, int(k)), uv, depth)
        _, rows = scene.opacities_at(float(times[k]))
        if len(times) > LONG_CLIP and rows is not None:
            found = np.where(np.isin(np.arange(D), rows[scene.n_static :].cpu().numpy() - scene.n_static), found, 0)
        votes.append(found)
    return np.stack(votes)


def voting_frames(T: int) -> np.ndarray:
    """Frames in whose masks the dynamic Gaussians look up their instance; in a long clip each is there in some."""
    return spread(T, VOTING_FRAMES if T <= LONG_CLIP else T // VOTING_EVERY)


def at_pixels(instances: np.ndarray, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Values [D] of an image [H, W] at the pixels nearest to uv [D, 2]; 0 outside and behind the camera."""
    height, width = instances.shape
    column, row = np.round(np.where(np.isfinite(uv), uv, -1)).T
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.zeros(len(uv), np.int64)
    found[seen] = instances[row[seen].astype(int), column[seen].astype(int)]
    return found


def elected(votes: np.ndarray) -> np.ndarray:
    """The most frequent non-zero vote of every column of [F, D], renumbered 1, 2, ... by frequency; 0 without a vote.

    Beyond MOST instances the rarest are 0.
    """
    D = votes.shape[1]
    numbers, numbered = np.unique(votes, return_inverse=True)
    columns = np.broadcast_to(np.arange(D), votes.shape)
    counts = np.zeros((D, len(numbers)), np.int64)
    np.add.at(counts, (columns.ravel(), numbered.ravel()), 1)
    counts[:, numbers == 0] = 0
    winner = np.where(counts.any(axis=1), numbers[counts.argmax(axis=1)], 0) if len(numbers) else np.zeros(D, int)
    present, sizes = np.unique(winner[winner > 0], return_counts=True)
    ranked = present[np.argsort(-sizes, kind="stable")][:MOST]
    renumbered = np.zeros(int(winner.max(initial=0)) + 1, np.uint8)
    renumbered[ranked] = np.arange(1, len(ranked) + 1)
    return renumbered[winner]
