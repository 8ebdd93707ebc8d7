"""Estimate the probability that a pixel moves in the world, from flow and the cameras of the previous round."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from stages.motion import drift, epipolar, hiding, photometric, resweep
from stages.motion.epipolar import Evidence
from stages.motion.options import MotionOptions
from stages.motion.pooling import pool
from stages.motion.static_paths import StaticScene
from stages.shared import cli, drawing
from stages.shared.artifacts import read_dense, read_metadata, write_dense
from stages.shared.atomic import copy
from stages.shared.cameras import Cameras, read_readout, scale_intrinsics, usable_cameras
from stages.shared.cli import In, Out
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import read_reduced, write_figure
from stages.shared.log import logger
from stages.shared.masks import read_scene_on_grid
from stages.shared.rows import OFTEN_READ_BYTES
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.settled import Solved, results_to_keep
from stages.shared.static_flow import resample

if TYPE_CHECKING:
    from stages.shared.rolling import RollingShutter

FLOW_CURVE = (0.17, 0.04)
CAMERA_CURVE = (0.37, 0.1)
"""Pooled residual at which the probability of motion is 0.5, and the width of the transition; without, with cameras.

Two-view geometry absorbs part of every motion, so the threshold without cameras is lower.
"""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    output: Annotated[
        Path, Out("prior.arrow: probability of motion, the weight of its evidence and the best static inverse depth")
    ],
    figure: Annotated[Path, Out("picture for the report: frames and their prior")],
    options: MotionOptions,
    previous_poses: Annotated[Path | None, In("poses.parquet of the round before")] = None,
    previous_depth: Annotated[Path | None, In("depth.arrow of the round before")] = None,
    previous_prior: Annotated[Path | None, In("prior.arrow of the round before")] = None,
    previous_figure: Annotated[Path | None, In("picture of the round before")] = None,
    earlier_poses: Annotated[Path | None, In("poses.parquet that the round before began with")] = None,
    earlier_depth: Annotated[Path | None, In("depth.arrow that the round before began with")] = None,
) -> str:
    """Estimate the probability that a pixel moves in the world, from geometry alone.

    Without cameras the evidence is the epipolar residual of the flow over many frame pairs (the homography residual
    where no pair shows parallax). With the cameras of the previous round it is the residual at the best depth of each
    pixel, which the images must confirm where flow is unreliable; the drift of long tracks, which shows slow motion;
    what hides static surface that seems nearer; and, of things that the flow loses, what a single frame shows. A
    rolling shutter that these cameras have is taken out of the flow first; pictures are compared, and evidence is
    pooled, along the flow as it is. The metadata of the output says which was used, and why. If the round before began
    with the same cameras, its results are carried over.
    """
    frames = read_sequence(sequence)
    begun = Solved(previous_poses, previous_depth), Solved(earlier_poses, earlier_depth)
    if kept := results_to_keep(*begun, (previous_prior, previous_figure), flow):
        for source, target in zip(kept, (output, figure), strict=True):
            copy(source, target)
        return f"cameras unchanged: {read_metadata(output)['moving_share']:.1%} of the pixels seem to move"
    matched, scale = read_dense(flow, OFTEN_READ_BYTES), float(read_metadata(flow)["scale"])
    scene = read_scene_on_grid(frames, matched["confidence"].shape[:0:-1])
    pairs = FlowPairs(matched, scene=scene)
    rgb = read_reduced(frames.frames, pairs.confidence.shape[:0:-1])
    evidence, passing, static_depth, facts = _evidence(frames, rgb, pairs, scale, begun[0], options.seed)
    if scene is not None:
        evidence = Evidence(evidence.residual, evidence.weight * scene)
    residual = pool(evidence, rgb, pairs)
    np.maximum(residual, passing, out=residual)  # what one frame shows, no other can confirm
    probability = to_probability(residual, *(FLOW_CURVE if facts["source"] == "flow" else CAMERA_CURVE))
    if scene is not None:
        probability *= scene
    facts |= {"moving_share": float((probability > 0.5).mean())}
    logger.info("%s: %s", frames.name, facts)
    columns = {"frame": np.array(frames.numbers), "probability": probability.astype(np.float16)}
    columns["weight"] = evidence.weight.astype(np.float16)
    if static_depth is not None:
        columns["static_depth"] = static_depth
    write_dense(output, columns, {"units": "probability", **facts, "options": options.model_dump(mode="json")})
    write_figure(figure, _picture(rgb, probability))
    return f"{facts['moving_share']:.1%} of the pixels seem to move"


def to_probability(residual: np.ndarray, midway: float, spread: float) -> np.ndarray:
    """Probability of motion of a pooled residual [...] in 0..1: a logistic curve."""
    return np.asarray(1 / (1 + np.exp((midway - residual) / spread)))


def _evidence(
    frames: Sequence, rgb: np.ndarray, pairs: FlowPairs, scale: float, previous: Solved, seed: int
) -> tuple[Evidence, np.ndarray, np.ndarray | None, dict[str, Any]]:
    """Evidence from the cameras of the round before or, without any, from flow; otherwise as `_from_cameras`."""
    poses, depth = previous
    cameras = usable_cameras(poses, depth, "the prior comes from flow alone")
    if cameras is None or poses is None or depth is None:
        evidence, facts = _from_flow(pairs, len(frames.numbers), seed)
        return evidence, np.zeros(1, np.float16), None, facts
    shutter = None
    if readout := read_readout(poses):
        from stages.shared.rolling import rolling_shutter  # with much of scipy, which other clips spare

        shutter = rolling_shutter(frames, cameras, readout, depth, scale)
    stride_px = float(read_metadata(depth)["stride_px"])
    return _from_cameras(rgb, pairs, cameras, read_dense(depth), scale, stride_px, shutter)


def _from_flow(pairs: FlowPairs, T: int, seed: int) -> tuple[Evidence, dict[str, Any]]:
    """Evidence from two-view geometry, and which model was used."""
    flat = epipolar.flat_share(pairs, seed)
    parallax = flat < epipolar.FLAT_SHARE
    evidence = epipolar.two_view_evidence(pairs, T, parallax, seed)
    model = "fundamental matrices" if parallax else "homographies: too little parallax for epipolar geometry"
    return evidence, {"source": "flow", "model": model, "flat_share": flat}


def _from_cameras(
    rgb: np.ndarray,
    pairs: FlowPairs,
    cameras: Cameras,
    depth: dict[str, np.ndarray],
    scale: float,
    stride_px: float,
    shutter: "RollingShutter | None",
) -> tuple[Evidence, np.ndarray, np.ndarray, dict[str, Any]]:
    """Evidence from the cameras of the previous round with depth searched anew, what single frames show [T, h, w], that
    inverse depth [T, h, w], and which model was used."""
    h, w = pairs.confidence.shape[1:]
    seen = cameras.cam_from_world, scale_intrinsics(cameras.Ks, scale)
    unobserved = cameras.status == "unobserved"  # their poses are interpolated, so their flow is no evidence
    pairs = pairs.counting(~(unobserved[pairs.source] | unobserved[pairs.target]))
    at_once = shutter.taken_out(pairs) if shutter else pairs
    evidence, inverse_depth, sigma_px = resweep.camera_evidence(
        at_once, *seen, resample(depth["inverse_depth"], stride_px * scale, h, w)
    )
    drifting = drift.drifting(StaticScene(at_once, rgb, seen, inverse_depth, evidence.residual), rgb)
    drifting[hiding.hiding(rgb, seen, inverse_depth, evidence)] = 1
    lines = shutter.projections(pairs, h) if shutter else resweep.projections(pairs, *seen)
    evidence, passing = photometric.corroborate(evidence, rgb, pairs, lines, inverse_depth, drifting)
    passing[unobserved] = 0
    rotating = set(cameras.status[~unobserved]) == {"rotation-only"}
    model = "rotations: the camera does not translate" if rotating else "depth re-sweep"
    facts = {"source": "cameras", "model": model, "sigma_px": sigma_px}
    return evidence, passing, inverse_depth.astype(np.float16), facts


def _picture(rgb: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """A few frames, each beside its probability of motion."""
    shown = drawing.spread(len(probability), 4)
    cells = [image for k in shown for image in (rgb[k], drawing.scalar_to_rgb(probability[k], 0, 1))]
    return drawing.contact_sheet(cells, columns=4)


if __name__ == "__main__":
    cli.run(main)
