"""Dense optical flow with confidence between near frames, and between distant ones that share enough of the view."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from stages.flow import noise
from stages.flow.confidence import flow_confidence, texture_confidence
from stages.flow.dis import estimate_flow
from stages.flow.edges import Edge, edge_list, long_edges
from stages.flow.matches import restarted_pair
from stages.flow.options import FlowOptions
from stages.flow.true_flow import Truth, read_truth, true_flow
from stages.given.files import of_sequence
from stages.given.flow import GivenFlow, check_against_frames, find_edges, read_on_grid
from stages.shared import cli, drawing
from stages.shared.artifacts import write_dense
from stages.shared.cli import In, Out
from stages.shared.images import read_reduced, reduced_size, write_figure
from stages.shared.log import logger
from stages.shared.masks import read_scene_on_grid, within
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.threads import threaded
from stages.shared.warp import is_inside

DIS_PATCH_PX = 8
"""Flow within half of this distance from a logo may be that of the logo."""
Flows = dict[Edge, np.ndarray]


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    output: Annotated[Path, Out("pairs.arrow: flow and confidence of every directed edge")],
    figure: Annotated[Path, Out("picture for the report: frames, flow, confidence")],
    options: FlowOptions,
) -> str:
    """Estimate dense optical flow with confidence between pairs of frames by dense inverse search.

    The search for a longer edge starts from the chained flow of shorter ones. Neighbours with large motion are searched
    again from sparse matches, and that flow is taken where its photometric residual is lower. Distant frames are
    matched where both show enough of the same view. Flow is in pixels of the flow grid: the frames, reduced to at most
    --max-width-px.
    """
    frames = read_sequence(sequence)
    rgb = read_reduced(frames.frames, reduced_size(frames.width, frames.height, options.max_width_px))
    T, h, w = rgb.shape[:3]
    given = _given(options.given, frames, rgb)
    if options.source == "truth":
        flows, confidences = _take(read_truth(frames, w, h), T, options)
        facts: dict[str, Any] = {}
    else:
        flows, confidences, facts = _match(rgb, options, given)
    edges = sorted(flows)
    if (scene := read_scene_on_grid(frames, (w, h))) is not None:
        scene = cv2.erode(scene.astype(np.uint8), np.ones((DIS_PATCH_PX + 1,) * 2, np.uint8), borderValue=1) > 0
        confidences = {edge: confidences[edge] * within(scene, flows[edge]) for edge in edges}
    flow = np.stack(threaded(lambda edge: stored(flows[edge]), edges))
    confidence = np.stack([confidences[edge].astype(np.float16, copy=False) for edge in edges])
    facts |= {"source": options.source, "long_edges": sum(j - i > max(options.offsets) for i, j in edges)}
    facts |= {"confident_share": float(np.mean(confidence > 0.5))}
    if given:
        others = ", the others estimated" if len(given) < len(edges) else ""
        facts["given"] = f"{len(given)} of {len(edges)} edges{others}"
    logger.info("%d edges of %d x %d px: %s", len(edges), w, h, facts)
    metadata: dict[str, Any] = {
        "units": "pixels of the flow grid",
        "width": w,
        "height": h,
        "scale": w / frames.width,
        **facts,
    }
    metadata["options"] = options.model_dump(mode="json")
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    write_dense(output, {"source": source, "target": target, "flow": flow, "confidence": confidence}, metadata)
    write_figure(figure, _picture(rgb, edges, flow, confidence))
    told = f" ({len(given)} given, {len(edges) - len(given)} estimated)" if given else ""
    return f"{len(edges)} pairs{told}, {facts['confident_share']:.0%} of the pixels confident"


def stored(flow: np.ndarray) -> np.ndarray:
    """Flow [h, w, 2] px as pairs.arrow holds it: float16, clipped to twice the longer side of the frame.

    The relative rounding error is at most 1/2048, 0.06 px at 128 px; it averages out over the pixels that determine a
    camera. Clipping keeps float16 finite: true flow of points beside the camera has no upper limit.
    """
    longest = 2 * max(flow.shape[:2])
    return np.clip(flow, -longest, longest).astype(np.float16)


def _given(path: str | None, frames: Sequence, rgb: np.ndarray) -> dict[Edge, GivenFlow]:
    """The flow that the user hands in for frames [T, h, w, 3], checked; empty if there is none."""
    if path is None:
        return {}
    folder, size = of_sequence(path, frames.name), (frames.width, frames.height)
    paths = find_edges(folder, frames)
    read = threaded(lambda edge: read_on_grid(paths[edge], size, rgb.shape[2:0:-1]), paths)
    given = dict(zip(paths, read, strict=True))
    check_against_frames(given, np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb]), folder)
    return given


def _match(
    rgb: np.ndarray, options: FlowOptions, given: Mapping[Edge, GivenFlow]
) -> tuple[Flows, Flows, dict[str, Any]]:
    """Flow [h, w, 2] px and confidence [h, w] of all edges between frames [T, h, w, 3] uint8, and facts for the log.

    Given flow is not estimated; given edges are matched both ways, also where they are longer than the others.
    """
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb])
    nearest = [(i, i + min(options.offsets)) for i in range(len(rgb) - min(options.offsets))]
    short = edge_list(len(rgb), options.offsets)
    known = {edge: of.flow for edge, of in given.items()}
    threads, scale = cv2.getNumThreads(), options.finest_scale
    cv2.setNumThreads(1)
    variances = threaded(noise.flow_variance, grey)
    noisy = noise.hides_texture(grey, variances)
    if noisy:
        grey, variances, left = _averaged(rgb, scale, threads)
        scale = max(scale, int(left > noise.COARSE_PX**2))
    both = [edge for pair in nearest for edge in (pair, pair[::-1])]
    flow = {edge: known[edge] for edge in short if edge in known}
    flow |= estimate_flow(grey, [edge for edge in both if edge not in known], scale, threads, flow)
    anew: Flows = {}
    open_pairs = [pair for pair in nearest if not {pair, pair[::-1]} <= set(known)]
    for found in threaded(lambda pair: restarted_pair(rgb, grey, flow, pair, scale), open_pairs):
        anew |= {edge: of for edge, of in found.items() if edge not in known}
    flow |= anew
    flow |= estimate_flow(grey, [edge for edge in short if edge not in flow], scale, threads, flow)
    others = {edge for i, j in known if (i, j) not in flow for edge in ((i, j), (j, i))}
    longer = sorted({*long_edges(flow, len(rgb), options.long_edges), *others})
    flow |= known
    flow |= estimate_flow(grey, [edge for edge in longer if edge not in flow], scale, threads, flow)

    textured = threaded(texture_confidence, variances)

    def confidence(edge: Edge) -> np.ndarray:
        i, j = edge
        of = given.get(edge)
        if of is not None and of.confidence is not None:
            return (of.confidence * (of.known & is_inside(of.flow))).astype(np.float16)
        found = flow_confidence(flow[i, j], flow[j, i], grey[i], grey[j], textured[i])
        return (found if of is None else found * of.known).astype(np.float16)

    confidences = dict(zip(flow, threaded(confidence, flow), strict=True))
    cv2.setNumThreads(threads)
    return flow, confidences, {"started_from_matches": len(anew), "frames_averaged": noisy}


def _averaged(rgb: np.ndarray, finest_scale: int, threads: int) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Grey frames averaged over time along their flow, and the variance of their flow.

    Returns:
        frames [T, h, w] uint8; the variance [h, w] px^2 of the flow of each frame (`noise.averaged_variance`); the
        median of `noise.flow_variance` for the remaining noise, px^2.
    """
    loud = noise.quiet_grey(rgb)
    level = float(np.mean([noise.noise_variance(frame) for frame in loud]))
    flow = estimate_flow(np.rint(loud).astype(np.uint8), edge_list(len(loud), noise.REACH), finest_scale, threads)
    frames, left = zip(*threaded(lambda i: noise.averaged(loud, flow, i, level), range(len(loud))), strict=True)
    typical = noise.typical_variance(threaded(noise.flow_variance, frames, left))
    return np.stack(frames), threaded(noise.averaged_variance, frames, left), typical


def _take(truth: Truth, T: int, options: FlowOptions) -> tuple[Flows, Flows]:
    """True flow [h, w, 2] px of all edges of T frames, and its confidence [h, w]: 1 where it is known, else 0."""
    short = {edge: true_flow(truth, edge) for edge in edge_list(T, options.offsets)}
    longer = long_edges({edge: flow for edge, (flow, _) in short.items()}, T, options.long_edges)
    steps = short | {edge: true_flow(truth, edge) for edge in longer}
    return {edge: flow for edge, (flow, _) in steps.items()}, {edge: known for edge, (_, known) in steps.items()}


def _picture(rgb: np.ndarray, edges: list[Edge], flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """One row per shown frame: the frame, its flow to the next frame, and the confidence of that flow."""
    onward = [e for e, (i, j) in enumerate(edges) if j - i == min(b - a for a, b in edges if b > a)]
    shown = [onward[k] for k in drawing.spread(len(onward), 4)]
    longest = float(np.percentile(np.linalg.norm(flow[shown].astype(np.float32), axis=-1), 98))
    cells = []
    for e in shown:
        coloured = drawing.flow_to_rgb(flow[e].astype(np.float32), longest)
        cells += [rgb[edges[e][0]], coloured, drawing.scalar_to_rgb(confidence[e].astype(np.float32), 0, 1)]
    return drawing.contact_sheet(cells, columns=3)


if __name__ == "__main__":
    cli.run(main)
