"""How often a changing focal length is found: finished flow of scenes, zoomed afterwards by known amounts.

    python -m benchmarks.zoom_decisions results/simulated/demo results/simulated/orbit_two

A zoom about the principal point moves every pixel by a known factor, so the flow of a scene without zoom becomes that
of the same scene with one, with the errors that real flow has. Without masks: those of the scene may rest on its poses.
Prints a line per scene and strength, and the table of decisions.
"""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.ba import classify
from stages.ba.estimate import PRIOR_FOCAL
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.guesses import Observed
from stages.ba.start import find_start
from stages.ba.state import FocalPrior
from stages.shared.artifacts import read_dense
from stages.shared.warp import bilinear

STRENGTHS = (0.0, 0.01, 0.03, 0.1, 0.3)
"""Last focal length over the first, minus 1."""
STRIDE_PX, START_FOCAL = 8, 1.05


def zoomed(columns: dict[str, np.ndarray], strength: float) -> tuple[FlowGraph, np.ndarray]:
    """The graph of flow/pairs.arrow as if the lens had zoomed by `strength`, and its zoom [T]."""
    source, target = columns["source"], columns["target"]
    T = int(target.max()) + 1
    zoom = np.exp(np.log1p(strength) * (1 - np.cos(np.linspace(0, np.pi, T))) / 2)
    graph = build_graph(source, target, columns["flow"], columns["confidence"], T, STRIDE_PX)
    if not strength:
        return graph, zoom
    matches, weights = graph.matches.copy(), graph.weights.copy()
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        before = graph.centre + (graph.pixels - graph.centre) / zoom[i]
        there = before + bilinear(columns["flow"][e].astype(np.float32), before)
        matches[e] = graph.centre + (there - graph.centre) * zoom[j]
        weights[e] = bilinear(columns["confidence"][e].astype(np.float32), before)
    return replace(graph, matches=matches, weights=weights), zoom


def decide(graph: FlowGraph, zoom: np.ndarray) -> tuple[str, str]:
    """The decision about a graph with this zoom [T], and the numbers behind it in words."""
    statistics = classify.measure(graph, None, 0)
    if statistics.camera != "moving":
        return f"camera {statistics.camera}", ""
    prior = FocalPrior(PRIOR_FOCAL * graph.width)
    start = find_start(Observed(graph, graph, None, [START_FOCAL * graph.width], statistics, prior, 0, tested=True))
    evidence, found = start.zoom, start.candidate.state.zoom
    assert evidence is not None
    words = f"{evidence.reason}, {evidence.seconds:.1f} s"
    if found is not None:
        apart = np.log(found / zoom)
        words += f", curve off by at most {100 * np.abs(apart - apart.mean()).max():.2f} %"
    return evidence.decision, words


def main(folders: list[Path]) -> None:
    """Print the decisions about the scenes of these results folders."""
    table: dict[float, Counter[str]] = {strength: Counter() for strength in STRENGTHS}
    for folder in folders:
        columns = read_dense(folder / "flow/pairs.arrow")
        for strength in STRENGTHS:
            decision, words = decide(*zoomed(columns, strength))
            table[strength][decision] += 1
            print(f"{folder.name}, {100 * strength:g} %: {decision} {words}", flush=True)
    for strength, decisions in table.items():
        print(f"{100 * strength:g} %: " + ", ".join(f"{name} {count}" for name, count in sorted(decisions.items())))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
