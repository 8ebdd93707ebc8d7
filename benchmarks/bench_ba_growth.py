"""How the adjustment grows with the frames: CPU seconds, peak memory and path error on clips from true geometry.

Run as `python -m benchmarks.bench_ba_growth --frames 50 200 1000`. A camera walks along a winding path; flow follows
from its poses and from depth that is drawn for every frame, with noise of 0.15 px per pixel and 0.05 px per edge. There
are no images: matches are made on the grid of `--stride` px of frames of 512 x 288 px. Each clip runs in a process of
its own.
"""

import argparse
import multiprocessing
import resource
import time

import numpy as np

from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.shared import lie
from stages.shared.cameras import frame_from_grid, pixel_grid

WIDTH, HEIGHT, FOCAL_PX = 512, 288, 512.0
OFFSETS = (1, 2, 3, 5, 12)
NOISE_PX, EDGE_NOISE_PX = 0.15, 0.05


def walk(T: int) -> np.ndarray:
    """Poses [T, 4, 4] of a camera that walks and looks around; the first is the identity."""
    t = np.arange(T)
    yaw = 0.5 * np.sin(t * np.pi / 90) + 0.2 * np.sin(t * np.pi / 23.5) + t * np.pi / 350
    R = lie.exp_so3(np.stack([0.05 * np.sin(t * np.pi / 30), yaw, 0.02 * np.sin(t * np.pi / 16.5)], axis=1))
    steps = 0.06 * np.einsum("tba,b->ta", R, [0.35, 0.05, 1.0])
    centres = np.append(np.zeros((1, 3)), np.cumsum(steps, axis=0)[:-1], axis=0)
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, -np.einsum("tab,tb->ta", R, centres)
    return np.asarray(poses @ lie.inverse(poses[0]))


def clip(T: int, stride: int, zoom: np.ndarray | None = None) -> tuple[FlowGraph, np.ndarray]:
    """Matches of T frames, and their true poses [T, 4, 4]; `zoom`: focal length of each frame [T], over FOCAL_PX."""
    random, poses = np.random.default_rng(0), walk(T)
    pixels = frame_from_grid(pixel_grid(HEIGHT // stride, WIDTH // stride), stride).reshape(-1, 2)
    (u, v), phase = (pixels / [WIDTH, HEIGHT]).T, random.uniform(0, 2 * np.pi, (T, 3, 1))
    waves = 0.15 * np.sin(6 * u + phase[:, 0]) * np.sin(5 * v + phase[:, 1]) + 0.1 * (
        np.sin(17 * u + phase[:, 2]) > 0.4
    )
    inverse_depth = np.maximum(0.25 + 0.9 * v**2 + waves, 0.05)
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if abs(i - j) in OFFSETS]).T
    centre = np.array([WIDTH - 1, HEIGHT - 1]) / 2
    rays = np.column_stack([(pixels - centre) / FOCAL_PX, np.ones(len(pixels))])
    focals_px = FOCAL_PX * (np.ones(T) if zoom is None else zoom)
    matches = np.empty((len(source), len(pixels), 2), np.float32)
    weights = np.empty(matches.shape[:2], np.float32)
    for e, motion in enumerate(poses[target] @ lie.inverse(poses)[source]):
        rays[:, :2] = (pixels - centre) / focals_px[source[e]]
        points = rays @ motion[:3, :3].T + inverse_depth[source[e], :, None] * motion[:3, 3]
        match = focals_px[target[e]] * points[:, :2] / np.maximum(points[:, 2:], 0.05) + centre
        seen = (points[:, 2] > 0.1) & (match >= 0).all(axis=1) & (match < [WIDTH, HEIGHT]).all(axis=1)
        noise = NOISE_PX * random.standard_normal(match.shape) + EDGE_NOISE_PX * random.standard_normal(2)
        matches[e], weights[e] = match + noise, np.where(seen, random.uniform(0.6, 1, len(seen)), 0)
    pointer = np.searchsorted(source, np.arange(T + 1))
    data = (np.ascontiguousarray(source), np.ascontiguousarray(target), pointer, pixels, matches, weights)
    return FlowGraph(*data, centre, WIDTH, HEIGHT, stride, masked=True), poses


def path_error(cam_from_world: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance of the camera centres after similarity alignment, as a share of the length of the path."""
    a, b = (lie.inverse(poses)[:, :3, 3] for poses in (cam_from_world, truth))
    length = np.linalg.norm(np.diff(b, axis=0), axis=1).sum()
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, singular, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    aligned = (singular * signs).sum() / (a**2).sum() * a @ (U * signs @ Vt).T
    return float(np.sqrt(((aligned - b) ** 2).sum(axis=1).mean()) / length)


def measure(T: int, stride: int, decide: bool) -> None:
    """Print a line about one clip."""
    graph, truth = clip(T, stride)
    choice = "auto" if decide else "no"
    began = time.process_time()
    options = BAOptions.model_validate({"start_focals": (1.05,), "zoom": choice, "rolling_shutter": choice})
    found = estimate(Problem(graph, masked=True), options)
    seconds, peak = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    error = 100 * path_error(found.state.cam_from_world, truth)
    print(f"{T:6} {seconds:10.1f} {peak:10.0f} {error:12.4f} {len(found.steps):10}", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[50, 200, 1000])
    parser.add_argument("--stride", type=int, default=32)
    parser.add_argument("--decide", action="store_true", help="also decide about zoom and rolling shutter")
    given = parser.parse_args()
    print("frames  CPU s    peak MB  error, % of path  iterations")
    for T in given.frames:
        process = multiprocessing.get_context("spawn").Process(target=measure, args=(T, given.stride, given.decide))
        process.start()
        process.join()


if __name__ == "__main__":
    main()
