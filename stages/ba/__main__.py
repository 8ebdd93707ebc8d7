"""Estimate camera poses, focal lengths and depth from flow and masks by dense bundle adjustment."""

from pathlib import Path
from typing import Annotated

from stages.ba import rounds
from stages.ba.options import BAOptions
from stages.shared import cli
from stages.shared.artifacts import read_metadata
from stages.shared.cli import In, Out
from stages.shared.sequences import read_sequence


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    poses: Annotated[Path, Out("poses.parquet: pose, intrinsics, covariance and status per frame")],
    trajectory: Annotated[Path, Out("trajectory.tum: world-from-camera, for evo and others")],
    depth: Annotated[Path, Out("depth.arrow: inverse depth and its variance per frame")],
    convergence: Annotated[Path, Out("convergence.parquet: cost, step, damping and seconds per iteration")],
    figure: Annotated[Path, Out("picture for the report")],
    options: BAOptions,
    masks: Annotated[Path | None, In("folder of dynamic masks, 255 = dynamic")] = None,
    previous_poses: Annotated[Path | None, In("poses.parquet of the round before")] = None,
    previous_depth: Annotated[Path | None, In("depth.arrow of the round before")] = None,
    previous_convergence: Annotated[Path | None, In("convergence.parquet of the round before")] = None,
    previous_figure: Annotated[Path | None, In("picture of the round before")] = None,
    previous_masks: Annotated[Path | None, In("masks of the round before")] = None,
) -> str:
    """Estimate camera poses, focal lengths and depth from flow and masks.

    All frames share one focal length unless pixels held out of the fit are explained much better by one per frame. All
    rows count as exposed at once unless these are explained much better by a rolling shutter: poses are then those of
    the middle row. With the masks and all results of the round before, itself not the first, nothing is estimated where
    the static area is still the same: these results are carried over.

    Masks that leave too little static area, or a worse path, are ignored: `masks_trusted` in poses.parquet is false for
    these frames, and later stages follow it. A camera that only rotates, or hardly moves, is detected and solved with
    the matching model. Warnings about the solution are stored as `flags` in the metadata of poses.parquet. A sequence
    that cannot be solved gets the status "failed" and identity poses.
    """
    frames, about = read_sequence(sequence), read_metadata(flow)
    size, results = (int(about["width"]), int(about["height"])), rounds.Results(poses, depth, convergence, figure)
    areas = rounds.read_static_areas(masks, frames, size)
    if previous_masks:
        before = rounds.complete(previous_poses, previous_depth, previous_convergence, previous_figure)
        then = rounds.read_static_areas(previous_masks, frames, size)
        if rounds.has_converged(before) and rounds.is_same(areas, then):
            return rounds.carry_over(frames, before, results, trajectory)

    from stages.ba import checkpoint, solving  # with compiled code and much of scipy, which a carried-over round spares

    named = solving.files_named(frames, options)
    inputs = [file for file in (sequence, flow, masks, previous_poses) if file is not None] + named
    with checkpoint.kept(poses, inputs, options):
        return solving.run(frames, flow, areas, masks, previous_poses, results, trajectory, options)


if __name__ == "__main__":
    cli.run(main)
