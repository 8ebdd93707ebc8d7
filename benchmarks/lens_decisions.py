"""How often radial distortion is found: finished flow of scenes, distorted afterwards by known lenses.

    python -m benchmarks.lens_decisions results/simulated/demo results/simulated/orbit_two

A lens about the principal point moves every pixel by a known amount, so the flow of a pinhole becomes that of the same
scene behind a lens, with the errors that real flow has. Coefficients are those at a focal length of 1.05 longer sides
of the image.
Prints a line per scene and lens, and the table of decisions.
"""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.ba.distortion import find_lens
from stages.ba.estimate import PRIOR_FOCAL
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.state import FocalPrior
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.lens import distort, undistort
from stages.shared.warp import bilinear

STRENGTHS = (0.0, -0.05, -0.1, -0.15, 0.1)
"""k1 of the lenses."""
STRIDE_PX, FOCAL = 8, 1.05


def bent(columns: dict[str, np.ndarray], k1: float, border_px: float) -> FlowGraph:
    """The graph of flow/pairs.arrow, with the border that it states, as if a lens had distorted the frames."""
    source, target = columns["source"], columns["target"]
    T = int(target.max()) + 1
    graph = build_graph(source, target, columns["flow"], columns["confidence"], T, STRIDE_PX, border_px=border_px)
    if not k1:
        return graph
    k, focal_px, centre = np.array([k1, 0.0]), FOCAL * graph.long_side_px, graph.centre
    before = centre + focal_px * undistort((graph.pixels - centre) / focal_px, k)
    shown = ((before >= 0) & (before <= [graph.width - 1, graph.height - 1])).all(axis=-1)
    matches, weights = graph.matches.copy(), graph.weights.copy()
    for e in range(len(source)):
        there = before + bilinear(columns["flow"][e].astype(np.float32), before)
        matches[e] = centre + focal_px * distort((there - centre) / focal_px, k)
        weights[e] = bilinear(columns["confidence"][e].astype(np.float32), before) * shown
    return replace(graph, matches=matches, weights=weights)


def main(folders: list[Path]) -> None:
    """Print the decisions about the scenes of these results folders."""
    table: dict[float, Counter[str]] = {strength: Counter() for strength in STRENGTHS}
    for folder in folders:
        columns, about = read_dense(folder / "flow/pairs.arrow"), read_metadata(folder / "flow/pairs.arrow")
        for strength in STRENGTHS:
            graph = bent(columns, strength, about.get("border_px", 0))
            found = find_lens(graph, FocalPrior(PRIOR_FOCAL * graph.long_side_px), 0)
            words = f"{found.evidence.reason}, {found.evidence.seconds:.1f} s"
            if found.coefficients is not None:
                k = found.coefficients * (FOCAL * graph.long_side_px / graph.corner_px) ** np.array([2, 4])
                words += f", k1 {k[0]:+.3f}, k2 {k[1]:+.3f}"
            table[strength][found.evidence.decision] += 1
            print(f"{folder.name}, k1 {strength:+g}: {found.evidence.decision}, {words}", flush=True)
    for strength, decisions in table.items():
        print(f"k1 {strength:+g}: " + ", ".join(f"{name} {count}" for name, count in sorted(decisions.items())))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
