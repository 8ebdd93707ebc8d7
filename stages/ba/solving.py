"""A run of the pose stage that carries nothing over: from flow and static areas to all results."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from stages.ba import checkpoint, cuts, diagnostics, from_truth, given, mover_depth, outputs, rounds, shutter
from stages.ba.depth import DepthMaps, depth_maps, dynamic_pixels, joined
from stages.ba.given_depth import given_depth_maps
from stages.ba.graph import FlowGraph, trusted_static_areas, without_loops
from stages.ba.growth import join_links, link_regions, number_regions
from stages.ba.guesses import PoseGuess
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.reading import BLOCK, Matches, read_matches, read_texture
from stages.ba.state import State
from stages.ba.weights import mask_graph, with_texture
from stages.given.files import of_sequence
from stages.shared.artifacts import read_metadata
from stages.shared.cameras import has_pose, read_cameras, write_cameras, write_tum
from stages.shared.log import logger, progress
from stages.shared.sequences import Sequence


def files_named(frames: Sequence, options: BAOptions) -> list[Path]:
    """The files that the solution depends on and that the sequence or the options name."""
    sources = options.intrinsics, options.poses_from
    handed = [file for file in (of_sequence(name, frames.name) for name in sources) if file.exists()]
    truth = [path for kind in frames.truth.values() for path in kind.values()] if "truth" in sources else []
    return [*frames.frames, *handed, *truth]


def run(
    frames: Sequence,
    flow: Path,
    areas: np.ndarray,
    masks: Path | None,
    previous_poses: Path | None,
    results: rounds.Results,
    trajectory: Path,
    options: BAOptions,
) -> str:
    """Estimate and write all results; these in words.

    Args:
        areas: static area [T, height, width] on the flow grid that the masks leave.
    """
    matches = read_matches(flow, len(frames.numbers), options)
    known = given.known_cameras(frames, options, matches.scale)
    static, ignored = trusted_static_areas(areas)
    everything = with_texture(matches.graph(options.stride_px, known), read_texture(frames, matches.size))
    if frames.times_s is not None:
        everything = replace(everything, times_s=np.array(frames.times_s))
    previous = _previous(previous_poses, matches.scale, max(matches.size))
    unmasked = everything if (static < 1).any() else None
    masked = unmasked is not None or previous is not None
    graph = replace(mask_graph(everything, static), masked=rounds.tell_movers(masks))
    known, doubts = given.examine(known, graph, options.seed)
    problem = Problem(graph, masked, known.known_focal_px, previous or known.guess, unmasked, options.iterations)
    solution = _solve(problem, matches.shot, known, options)
    flags = cuts.warnings(matches.shot, frames.numbers) + doubts + solution.flags
    flags += _round_warnings(solution, static[matches.shot], ignored[matches.shot], previous_poses)
    _log(frames.name, solution, flags)
    trusted = ~ignored & (solution.static is None or masks is None)
    if solution.static is not None:
        static, graph = solution.static, mask_graph(everything, solution.static)
    maps = _depth_maps(matches, known, graph, static, solution, options)
    if solution.rolling.decision == "rolling":
        graph = shutter.correct(graph, solution.state, solution.rolling.readout)
    stride_px = options.depth_stride_px / matches.scale
    maps, told = _taken_depth(maps, solution.state, known, frames, stride_px, options)
    cameras = replace(outputs.cameras_of(solution, graph, frames, matches.scale), masks_trusted=trusted)
    started = {"from_previous_round": previous is not None or known.fixed} | told
    about = outputs.pose_metadata(solution, flags, static[matches.shot], options) | started
    write_cameras(results.poses, cameras, about)
    write_tum(trajectory, cameras, frames.stamps)
    outputs.write_depth(results.depth, maps, frames, stride_px)
    outputs.write_convergence(results.convergence, solution)
    outputs.draw(results.figure, frames.name, solution, graph, cameras, maps)
    return f"{has_pose(cameras).sum()} of {len(frames.numbers)} frames, camera {solution.camera}, " + (
        f"focal length {_focal_in_words(cameras.Ks[:, 0, 0])} px ({solution.focal['decision']})"
    )


def _focal_in_words(focals_px: np.ndarray) -> str:
    """The focal lengths [T] of the frames: one number, or those of the first and the last frame if they differ."""
    first, last = focals_px[0], focals_px[-1]
    return f"{first:.0f}" if (focals_px == first).all() else f"{first:.0f} to {last:.0f}"


def _solve(problem: Problem, shot: np.ndarray, known: given.Known, options: BAOptions) -> Estimate:
    if not known.fixed:
        return cuts.estimate_shot(problem, shot, options)
    assert known.cam_from_world is not None, "fixed poses are given"
    assert problem.known_focal_px is not None, "fixed poses come with a focal length"
    return given.solve_depths(problem.graph, known.cam_from_world, problem.known_focal_px, options.seed, known.zoom)


def _taken_depth(
    estimated: DepthMaps,
    state: State,
    known: given.Known,
    frames: Sequence,
    stride_px: float,
    options: BAOptions,
) -> tuple[DepthMaps, dict[str, str]]:
    """The depth to write, and what is to be said of it in the metadata of the poses, if it is the user's."""
    if options.depth_from == "estimate":
        return estimated, {}
    scale = None
    if known.fixed and known.cam_from_world is not None:
        scale = from_truth.gauge_scale(state, known.cam_from_world)
    if options.depth_from == "truth":
        return from_truth.true_depth_maps(frames, estimated, stride_px, scale), {}
    folder = of_sequence(options.depth_from, frames.name)
    maps, told = given_depth_maps(frames, folder, estimated, stride_px, scale)
    return maps, {"given_depth": told}


def _log(name: str, solution: Estimate, flags: list[str]) -> None:
    logger.info("camera %s; focal length %s; residual %.3f px", solution.camera, solution.focal, solution.residual_px)
    for flag in flags:
        logger.warning("ba: %s: %s", name, flag)


def _depth_maps(
    matches: Matches,
    known: given.Known,
    graph: FlowGraph,
    static: np.ndarray,
    solution: Estimate,
    options: BAOptions,
) -> DepthMaps:
    """Depth of all frames from the finer matches of one block of frames after the other, which are many.

    Args:
        graph: the matches on which the solution was found.
    """
    state, rolling, T = solution.state, solution.rolling, graph.T
    observable = solution.camera in ("moving", "near-still")

    def of_block(first: int) -> np.ndarray:
        frames = first, min(first + BLOCK, T)
        fine = mask_graph(matches.graph(options.depth_stride_px, known, frames), static)
        if rolling.decision == "rolling":
            fine = shutter.correct(fine, shutter.resampled(state, graph, fine), rolling.readout)
        maps = depth_maps(fine, graph, state, static, observable, frames)
        return np.stack([maps.inverse_depth, maps.variance, maps.filled])

    blocks = (checkpoint.array(partial(of_block, first)) for first in progress(range(0, T, BLOCK), "depth"))
    maps = joined([DepthMaps(inverse_depth, variance, filled > 0) for inverse_depth, variance, filled in blocks])
    return maps if static.all() or not observable else _with_movers(maps, matches, known, static, state, options)


def _with_movers(
    maps: DepthMaps, matches: Matches, known: given.Known, static: np.ndarray, state: State, options: BAOptions
) -> DepthMaps:
    """The maps with the depth of what moves, followed from frame to frame."""
    T, stride = len(static), options.depth_stride_px
    numbers = number_regions(dynamic_pixels(static, stride))
    blocks = ((first, min(first + BLOCK, T)) for first in range(0, T, BLOCK))
    moving = (block for block in blocks if numbers[slice(*block)].any())
    graphs = (without_loops(matches.graph(stride, known, frames)) for frames in moving)
    links = join_links([link_regions(graph, numbers) for graph in graphs if len(graph.source)])
    return mover_depth.placed(maps, numbers, links, state.focals_px)


def _previous(poses: Path | None, scale: float, long_side_px: int) -> PoseGuess | None:
    """The poses of the previous round; None if it failed or found no translation.

    Args:
        scale: width of the flow grid over that of the frames. long_side_px: longer side of the flow grid.
    """
    if poses is None:
        return None
    cameras = read_cameras(poses)
    if set(cameras.status) & {outputs.STATUS["failed"], outputs.STATUS["rotating"]}:
        return None
    focals_px = cameras.Ks[:, 0, 0] * scale
    sides = read_metadata(poses).get("focal", {}).get("prior_sides")
    prior_px = sides and sides * long_side_px
    if (focals_px == focals_px[0]).all():
        return PoseGuess(cameras.cam_from_world, float(focals_px[0]), prior_px=prior_px)
    focal_px = float(np.exp(np.log(focals_px).mean()))
    return PoseGuess(cameras.cam_from_world, focal_px, focals_px / focal_px, prior_px=prior_px)


def _round_warnings(solution: Estimate, static: np.ndarray, ignored: np.ndarray, previous: Path | None) -> list[str]:
    """Warnings from the masks, ignored in some frames [T], and from the comparison with the previous round."""
    before = read_metadata(previous) if previous else {}
    found = diagnostics.of_masks(static, ignored, before.get("static_share"))
    return found + (diagnostics.of_rounds(solution.focal, before["focal"]) if before else [])
