"""Grey frames to be matched: as they are, or averaged over time along their flow where noise hides their texture."""

from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from stages.flow import noise
from stages.flow.confidence import texture_confidence
from stages.flow.dis import estimate_flow
from stages.flow.edges import Edge, edges_ending
from stages.flow.frames import BLOCK, Images, blocks
from stages.shared import costs
from stages.shared.artifacts import Dense, read_dense, unless_damaged, write_dense
from stages.shared.image_noise import noise_variance
from stages.shared.threads import threaded


class Frames(NamedTuple):
    """What is matched.

    Attributes:
        rgb: [h, w, 3] uint8; grey: [h, w] uint8; textured: `texture_confidence` [h, w], each per frame.
        finest_scale: finest pyramid level to search; 0 is full size.
        averaged: whether `grey` are averages.
    """

    rgb: Images
    grey: Images
    textured: Images
    finest_scale: int
    averaged: bool


def to_match(rgb: Images, finest_scale: int, threads: int, folder: Path) -> Frames:
    """The frames rgb [h, w, 3] uint8 made ready for matching; averages are kept in files of the folder."""
    grey = Images(len(rgb), lambda k: cv2.cvtColor(rgb[k], cv2.COLOR_RGB2GRAY))
    if noise.hides_texture(grey, grey.mapped(noise.flow_variance)):
        return _averaged(rgb, finest_scale, threads, folder)
    textured = Images(len(rgb), lambda k: texture_confidence(noise.flow_variance(grey[k])), BLOCK * 8)
    return Frames(rgb, grey, textured, finest_scale, averaged=False)


def _averaged(rgb: Images, finest_scale: int, threads: int, folder: Path) -> Frames:
    weights = noise.quiet_weights(rgb[len(rgb) // 2])
    loud = Images(len(rgb), lambda k: rgb[k] @ weights, BLOCK * 8)
    levels = [float(level) for level in loud.mapped(lambda frame: np.asarray(noise_variance(frame)))]
    files = _average(loud, float(np.mean(levels)), finest_scale, threads, folder)
    typical = float(np.median([value for file in files for value in read_dense(file)["typical"]]))
    block = lru_cache(2 * BLOCK)(lambda n: read_dense(files[n]))

    def column(name: str, held: int) -> Images:
        return Images(len(rgb), lambda k: np.array(block(k // BLOCK)[name][k % BLOCK]), held)

    scale = max(finest_scale, int(typical > noise.COARSE_PX**2))
    return Frames(rgb, column("grey", BLOCK * 20), column("textured", BLOCK * 8), scale, averaged=True)


def _average(loud: Images, level: float, finest_scale: int, threads: int, folder: Path) -> list[Path]:
    """Files of grey frames averaged along their flow, with their texture confidence and typical variance, by blocks.

    Blocks that an earlier run has written are taken over. A block needs the flow of the frames right before and behind
    it, so each is written when the next one is matched.

    Args:
        loud: [h, w] float32 frames; level: variance of their noise.
    """
    rounded = Images(len(loud), lambda k: np.rint(loud[k]).astype(np.uint8))
    runs = blocks(len(loud))
    files = [folder / f"averaged_{run.start:06d}.arrow" for run in runs]
    for left in filter(Path.exists, files):
        if unless_damaged(partial(read_dense, left)) is None:
            left.unlink()
    flow: dict[Edge, np.ndarray] = {}
    for n, run in enumerate([*runs, range(0)]):
        near = range(max(n - 1, 0), min(n + 2, len(runs)))
        if all(files[k].exists() for k in near):  # flow that ends here is for these alone, or for a longer one to start
            continue
        edges = [edge for edge in edges_ending(run, noise.REACH) if edge not in flow]
        flow |= estimate_flow(rounded, edges, finest_scale, threads, flow)
        if n > 0 and not files[n - 1].exists():
            write_dense(files[n - 1], _average_block(loud, flow, runs[n - 1], level))
            costs.keep(folder)
            done = runs[n - 1].start
            flow = {edge: of for edge, of in flow.items() if min(edge) >= done}
    return files


def _average_block(loud: Images, flow: dict[Edge, np.ndarray], run: range, level: float) -> Dense:
    frames, left = zip(*threaded(lambda i: noise.averaged(loud, flow, i, level), run), strict=True)
    variances = threaded(noise.averaged_variance, frames, left)
    typical = [np.median(of[::4, ::4]) for of in threaded(noise.flow_variance, frames, left)]
    textured = [texture_confidence(of) for of in variances]
    return Dense({"grey": np.stack(frames), "textured": np.stack(textured), "typical": np.array(typical)})
