"""Decide whether the lens has radial distortion, and undistort frames, flow and ground truth once if it has."""

import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from stages.ba import cuts
from stages.ba.distortion import NOT_TESTED, Lens, find_lens
from stages.ba.estimate import PRIOR_FOCAL
from stages.ba.graph import FlowGraph, build_graph, cut_out
from stages.ba.state import FocalPrior
from stages.lens.carry import CARRIED, carried_grid, carried_sequence, carry_flow, carry_images
from stages.lens.options import LensOptions
from stages.lens.pinhole import Pinhole, largest_pinhole
from stages.shared import cli
from stages.shared.artifacts import Dense, dense_writer, read_dense, read_json, read_metadata, write_json
from stages.shared.atomic import atomic, atomic_folder
from stages.shared.cameras import centred_intrinsics, scale_intrinsics
from stages.shared.cli import In, Out
from stages.shared.log import logger
from stages.shared.packing import Packed, pack
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.threads import threaded

STRIDE_PX = 8
MOST_FRAMES = 40
"""The coefficients are estimated from so many frames in the middle of a longer shot."""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    undistorted: Annotated[Path, Out("sequence.json of the frames that the later stages read")],
    pairs: Annotated[Path, Out("pairs.arrow of these frames")],
    images: Annotated[Path, Out("folder of undistorted frames and truth; empty if the originals are used")],
    lens: Annotated[Path, Out("lens.json: the decision, its evidence, the coefficients")],
    options: LensOptions,
) -> str:
    """Decide whether the lens has radial distortion, and undistort frames, flow and truth if it has.

    The later stages assume a pinhole camera. Without a distortion they read the frames and the flow as they are: no
    picture is written, and pairs.arrow is another name of the file of the flow. With one, frames have the size of the
    originals or, where these would not fill it, that of the largest rectangle of their proportions.
    """
    frames = read_sequence(sequence)
    found = _decide(frames, flow, options)
    evidence, content = found.evidence, read_json(sequence)
    logger.info("%s: lens %s: %s", frames.name, evidence.decision, evidence.reason)
    about: dict[str, Any] = {**asdict(evidence), "coefficients_px": None, "options": options.model_dump(mode="json")}
    with atomic_folder(images, CARRIED) as folder:
        if found.coefficients is None:
            _share(flow, pairs)
        else:
            pinhole = largest_pinhole(_of_frames(found.coefficients, read_metadata(flow)), frames)
            carry_images(frames, pinhole, folder)
            _write_flow(flow, pairs, pinhole)
            about |= _of(pinhole, frames)
            told = f"the lens has radial distortion, frames were undistorted: {evidence.reason}"
            content = carried_sequence(content, frames, pinhole, images, told)
    write_json(undistorted, content)
    write_json(lens, about)
    return f"lens {evidence.decision}" + ("" if evidence.shift is None else f", corner {100 * evidence.shift:+.1f} %")


def _decide(frames: Sequence, flow: Path, options: LensOptions) -> Lens:
    if options.distortion == "no":
        return Lens(None, NOT_TESTED)
    about = read_metadata(flow)
    graph = _graph(frames, read_dense(flow), float(about["scale"]), float(about.get("border_px", 0)))
    prior = FocalPrior(PRIOR_FOCAL * graph.long_side_px)
    return find_lens(graph, prior, options.seed, assumed=options.distortion == "yes")


def _graph(frames: Sequence, columns: Dense, scale: float, border_px: float) -> FlowGraph:
    """The matches of the longest shot, or of its middle."""
    centre = scale_intrinsics(centred_intrinsics(1, frames.width, frames.height), scale)[:2, 2]
    source, target, flow, confidence = (columns[name] for name in ("source", "target", "flow", "confidence"))
    T, release = len(frames.numbers), columns.release
    graph = build_graph(source, target, flow, confidence, T, STRIDE_PX, centre, release=release, border_px=border_px)
    shot = cuts.linked_frames(graph.source, graph.target, graph.weights, graph.T)
    inside = cuts.span(shot)
    spare = max(inside.stop - inside.start - MOST_FRAMES, 0)
    return cut_out(cuts.isolate(graph, shot), slice(inside.start + spare // 2, inside.stop - (spare + 1) // 2))


def _of_frames(coefficients: np.ndarray, about: dict[str, Any]) -> np.ndarray:
    """Coefficients relative to a corner of the flow grid as those in px of the frame."""
    radius_px = float(np.hypot(about["width"], about["height"])) / 2 / float(about["scale"])
    return coefficients / radius_px ** np.array([2, 4])


def _of(pinhole: Pinhole, frames: Sequence) -> dict[str, Any]:
    """What lens.json says of an undistorted sequence: k1 = coefficients_px[0] f^2, k2 = coefficients_px[1] f^4."""
    return {
        "coefficients_px": pinhole.coefficients.tolist(),
        "original": {
            "width": frames.width,
            "height": frames.height,
            "frames": [str(path.resolve()) for path in frames.frames],
        },
        "left": pinhole.left,
        "top": pinhole.top,
    }


def _write_flow(flow: Path, pairs: Path, pinhole: Pinhole) -> None:
    columns, about = read_dense(flow), read_metadata(flow)
    (w, h), scale = carried_grid(columns, pinhole)
    kept = {key: value for key, value in about.items() if key not in ("format_version", "code")}
    with dense_writer(pairs, kept | {"width": w, "height": h, "scale": scale, "undistorted": True}) as write:
        for edges, of_flow, confidence in carry_flow(columns, pinhole):
            ends = {name: columns[name][edges] for name in ("source", "target")}
            images = {"flow": of_flow, "confidence": confidence}
            write(ends | {name: Packed(threaded(pack, of), of.shape[1:]) for name, of in images.items()})


def _share(flow: Path, pairs: Path) -> None:
    """Make `pairs` another name of the file of the flow; a copy where it has one already, or can have none.

    Snakemake touches what a job has written. With a name for each setting of a sweep the job of one would make the flow
    newer than the results of all others, which would run again, one after the other, for ever.
    """
    with atomic(pairs) as partial:
        try:
            os.link(flow, partial)
        except OSError:
            shutil.copyfile(flow, partial)
        if partial.stat().st_nlink > 2:
            partial.unlink()
            shutil.copyfile(flow, partial)


if __name__ == "__main__":
    cli.run(main)
