"""Accuracy of optical flow and of its confidence against ground truth, for any folders in MPI-Sintel layout.

Run as `python -m benchmarks.flow_accuracy FOLDER [FOLDER ...]`, each a folder of frames `<training>/<pass>/<sequence>`
with ground truth beside it. Printed per sequence: end-point error of the flow to the next frame, over all pixels and by
true motion, and the share of confident flow with an error below 1 px. With true depth and cameras the same is printed
per frame distance, for pixels visible in both frames. Missing ground truth is named. `--options` sets options of the
flow stage (`python -m stages.flow --help`), e.g. `--options finest_scale=1`; `--frames 8` takes the first frames only.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from stages.evaluate.flow_error import MIN_CONFIDENCE, RIGHT_PX, SPEEDS_PX, FlowErrors, flow_errors, has_some_true_flow
from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.flow.true_flow import NEEDED, read_truth, true_flow
from stages.shared.artifacts import Dense, read_dense, write_json
from stages.shared.errors import InputError
from stages.shared.options import validate
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json


def measured(frames: Sequence, options: FlowOptions) -> tuple[Dense, float]:
    """Columns of pairs.arrow as the flow stage writes them, and its CPU seconds."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_json(folder / "sequence.json", sequence_to_json(frames))
        began = time.process_time()
        flow_stage.main(folder / "sequence.json", folder / "pairs.arrow", folder / "flow.png", options)
        seconds = time.process_time() - began
        return Dense({key: np.array(values) for key, values in read_dense(folder / "pairs.arrow").items()}), seconds


def summary(found: FlowErrors) -> str:
    """Errors of all pixels and by true motion, and accuracy of confident pixels, as text."""
    parts = [f"all {found.error_px.mean():.2f} px, visible {found.error_px[found.visible].mean():.2f}"]
    for low, high in SPEEDS_PX:
        errors = found.error_px[(found.motion_px >= low) & (found.motion_px < high)]
        mean = f"{errors.mean():.2f}" if len(errors) else "-"
        parts.append(f"{low:g}-{high:g} px: {mean} (n {len(errors)})")
    share = np.mean(found.confidence > MIN_CONFIDENCE)
    return f"{'; '.join(parts)}; confident {share:.2f}, of these right {found.right().mean():.3f}"


def by_distance(frames: Sequence, flow: dict[str, np.ndarray]) -> list[str]:
    """By frame distance: mean error of visible pixels, share of confident ones, and share of these that are right."""
    h, w = flow["confidence"].shape[1:]
    truth = read_truth(frames, w, h)
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for e, edge in enumerate(zip(flow["source"].tolist(), flow["target"].tolist(), strict=True)):
        true, known = true_flow(truth, edge)
        errors = np.linalg.norm(flow["flow"][e].astype(np.float32) - true, axis=-1)[known]
        found.setdefault(abs(edge[1] - edge[0]), []).append((errors, flow["confidence"][e][known] > MIN_CONFIDENCE))
    lines = []
    for distance, parts in sorted(found.items()):
        errors, sure = (np.concatenate(part) for part in zip(*parts, strict=True))
        right = f"{(errors[sure] < RIGHT_PX).mean():.3f}" if sure.any() else "-"
        lines.append(
            f"  {distance:2d} frames on: error {errors.mean():.2f} px, confident {sure.mean():.2f}, right {right}"
        )
    return lines


def report(folder: Path, limit: int | None, options: FlowOptions) -> list[str]:
    """Lines on the first `limit` frames of one sequence: the errors, or the ground truth that is missing.

    Raises:
        InputError: if the folder holds no sequence.
    """
    if not folder.is_dir():
        raise InputError(folder, "a folder of frames", "nothing there", "name <training>/<pass>/<sequence>")
    frames = check_sequence(folder.name, folder)
    frames = replace(frames, frames=frames.frames[:limit], numbers=frames.numbers[:limit])
    name = f"{folder.parent.name}/{folder.name}"
    if not has_some_true_flow(frames):
        return [f"{name}: no true flow in {folder.parents[1] / 'flow' / folder.name}, so nothing to measure"]
    flow, seconds = measured(frames, options)
    lines = [f"{name}, {len(flow['source'])} edges, {seconds:.1f} s of CPU time"]
    lines.append("  " + summary(flow_errors(frames, flow)))
    lacking = (kind for kind in NEEDED if not frames.has_truth(kind))
    missing = [f"  {kind} is missing for some frames, so no errors by frame distance" for kind in lacking]
    return [*lines, *(missing or by_distance(frames, flow))]


def main() -> None:
    """Print the errors of every sequence; exit code 2 and one line for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--frames", type=int, help="use the first frames only")
    parser.add_argument("--options", nargs="*", default=[], metavar="NAME=VALUE", help="options of the flow stage")
    arguments = parser.parse_args()
    chosen = {name: yaml.safe_load(value) for name, value in (pair.split("=", 1) for pair in arguments.options)}
    try:
        options = validate(FlowOptions, chosen, "--options")
        for folder in arguments.folders:
            print("\n".join(report(folder.absolute(), arguments.frames, options)), flush=True)
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)


if __name__ == "__main__":
    main()
