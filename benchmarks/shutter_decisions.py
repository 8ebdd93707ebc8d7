"""How often a rolling shutter is found: finished results of scenes without one, rolled afterwards by known readouts.

    python -m benchmarks.shutter_decisions results/simulated/demo results/simulated/orbit_two

With the poses and depths of a run, matches move as they would if rows were exposed one after the other; they keep the
errors that real flow has. The masks are those of the run. Prints a line per scene and readout, and the table of
decisions.
"""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.ba import dba, initialise, shutter
from stages.ba.estimate import PRIOR_FOCAL
from stages.ba.graph import FlowGraph, build_graph, static_areas
from stages.ba.state import FocalPrior, State, Unknowns
from stages.ba.weights import mask_graph
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.masks import read_masks
from stages.shared.sequences import read_sequence

READOUTS = (0.0, 0.1, 0.2, 0.4, 0.8)
STRIDE_PX, SIGMA_PX = 8, 0.5


def finished(folder: Path) -> tuple[FlowGraph, State, Unknowns]:
    """Masked matches of a results folder, its cameras with the best depths, and their unknowns."""
    about, columns = read_metadata(folder / "flow/pairs.arrow"), read_dense(folder / "flow/pairs.arrow")
    frames, cameras = read_sequence(folder / "sequence.json"), read_cameras(folder / "ba/poses.parquet")
    source, target, flow, confidence = (columns[name] for name in ("source", "target", "flow", "confidence"))
    graph = build_graph(source, target, flow, confidence, len(frames.numbers), STRIDE_PX)
    masks = np.stack(list(read_masks(folder / "masks", frames).values()))
    graph = mask_graph(graph, static_areas(masks, int(about["width"]), int(about["height"])))
    found = read_metadata(folder / "ba/poses.parquet")
    translation = found["camera"] != "rotating"
    focals_px = cameras.Ks[:, 0, 0] * float(about["scale"])
    zoom = None if (focals_px == focals_px[0]).all() else focals_px / focals_px.mean()
    free = found["focal"]["decision"] in ("estimated", "weakly observed")
    unknowns = Unknowns(free, translation, free and zoom is not None)
    focal_px = float(focals_px.mean())
    if not translation:
        return graph, State(cameras.cam_from_world, np.zeros((graph.T, len(graph.pixels))), focal_px, zoom), unknowns
    return graph, initialise.initial_state(graph, cameras.cam_from_world, focal_px, SIGMA_PX, zoom), unknowns


def main(folders: list[Path]) -> None:
    """Print the decisions about the scenes of these results folders."""
    table: dict[float, Counter[str]] = {readout: Counter() for readout in READOUTS}
    for folder in folders:
        graph, state, unknowns = finished(folder)
        for readout in READOUTS:
            rolled = replace(graph, matches=graph.matches + shutter.shifts(graph, state, readout))
            prior = FocalPrior(PRIOR_FOCAL * graph.width)
            found = shutter.weigh(rolled, state, unknowns, prior, assumed=False)
            moved_px = float(np.median(dba.errors_px(rolled, state)))
            table[readout][found.decision] += 1
            words = f"{found.decision}, {found.reason}, {found.seconds:.1f} s, residual {moved_px:.2f} px"
            print(f"{folder.name}, readout {readout:g}: {words}", flush=True)
    for readout, decisions in table.items():
        print(f"readout {readout:g}: " + ", ".join(f"{name} {count}" for name, count in sorted(decisions.items())))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
