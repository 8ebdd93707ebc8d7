"""Estimate dense optical flow with confidence between near frames of a sequence."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np

from stages.flow.confidence import flow_confidence
from stages.flow.dis import Edge, edge_list, estimate_flow
from stages.flow.options import FlowOptions
from stages.shared import cli, figures
from stages.shared.artifacts import write_dense
from stages.shared.cli import In, Out
from stages.shared.images import read_rgb, write_figure
from stages.shared.log import logger
from stages.shared.sequences import Sequence, read_sequence


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    output: Annotated[Path, Out("pairs.arrow: flow and confidence of every directed edge")],
    figure: Annotated[Path, Out("picture for the report: frames, flow, confidence")],
    options: FlowOptions,
) -> None:
    """Estimate dense optical flow between near frames by dense inverse search, longer edges started by chaining.

    Flow is in pixels of the flow grid: the frames, reduced to at most --max-width-px.
    """
    frames = read_sequence(sequence)
    scale = min(1.0, options.max_width_px / frames.width)
    rgb = _read_reduced(frames, scale)
    edges = edge_list(len(rgb), options.offsets)
    flow, confidence = _match(rgb, edges, options.finest_scale)
    h, w = rgb.shape[1:3]
    share = float(np.mean(confidence > 0.5))
    logger.info("%d edges of %d x %d px; %.0f %% of their pixels are confident", len(edges), w, h, 100 * share)
    metadata = {"units": "pixels of the flow grid", "width": w, "height": h, "scale": w / frames.width}
    metadata |= {"confident_share": share, "options": options.model_dump(mode="json")}
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    write_dense(output, {"source": source, "target": target, "flow": flow, "confidence": confidence}, metadata)
    write_figure(figure, _picture(rgb, edges, flow, confidence))


def _read_reduced(frames: Sequence, scale: float) -> np.ndarray:
    """All frames [T, h, w, 3] uint8, reduced by `scale`."""
    size = round(frames.width * scale), round(frames.height * scale)
    return np.stack([cv2.resize(read_rgb(path), size, interpolation=cv2.INTER_AREA) for path in frames.frames])


def _match(rgb: np.ndarray, edges: list[Edge], finest_scale: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow [E, h, w, 2] and confidence [E, h, w] float16 of the edges, pairs side by side."""
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    flow = estimate_flow(grey, edges, finest_scale, threads)

    def confidence(edge: Edge) -> np.ndarray:
        i, j = edge
        return flow_confidence(flow[i, j], flow[j, i], grey[i], grey[j]).astype(np.float16)

    with ThreadPoolExecutor(threads) as pool:
        confidences = list(pool.map(confidence, edges))
    cv2.setNumThreads(threads)
    return np.stack([flow[edge].astype(np.float16) for edge in edges]), np.stack(confidences)


def _picture(rgb: np.ndarray, edges: list[Edge], flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """A row per shown frame: the frame, its flow to the next one, the confidence of that flow."""
    onward = [e for e, (i, j) in enumerate(edges) if j - i == min(b - a for a, b in edges if b > a)]
    shown = [onward[k] for k in figures.spread(len(onward), 4)]
    longest = float(np.percentile(np.linalg.norm(flow[shown].astype(np.float32), axis=-1), 98))
    cells = []
    for e in shown:
        coloured = figures.flow_to_rgb(flow[e].astype(np.float32), longest)
        cells += [rgb[edges[e][0]], coloured, figures.scalar_to_rgb(confidence[e].astype(np.float32), 0, 1)]
    return figures.contact_sheet(cells, columns=3)


if __name__ == "__main__":
    cli.run(main)
