"""One iteration of dense bundle adjustment against torch and Ceres on the same pixels, and growth with frames.

Run as `python -m benchmarks.bench_ba`. Times are medians of alternated runs in one process, after a warm-up. Torch
builds the same reduced system in float64 with einsum and index_add (they agree to 1e-9). Ceres, through pycolmap,
adjusts poses and one free 3-D point per pixel, observed in the same frames.
"""

import time
from collections.abc import Callable

import numpy as np
import pycolmap
import torch

from benchmarks.timing import alternated
from stages.ba import proposal, reduced
from stages.ba.dense_system import DenseSystem
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.state import DEPTH_PRIOR, FocalPrior, State, Unknowns
from stages.shared import lie

WIDTH, HEIGHT = 512, 218
SIGMA_PX = 1.0
GATES = {"torch": 20.0, "Ceres": 10.0, "growth": 1.5}


def random_problem(T: int, stride: int, offsets: tuple[int, ...] = (1, 2, 3)) -> tuple[FlowGraph, State]:
    """A camera that moves sideways, slightly perturbed, over random depths; matches have noise of 0.3 px."""
    random = np.random.default_rng(0)
    edges = np.array([(i, j) for i in range(T) for j in range(T) if abs(i - j) in offsets])
    blank = np.zeros((1, HEIGHT, WIDTH, 2), np.float32)
    base = build_graph(edges[:1, 0], edges[:1, 1], blank, blank[..., 0], T, stride)
    E, P = len(edges), len(base.pixels)
    twists = np.outer(np.arange(T), [-0.05, 0, 0, 0, 0.002, 0]) + 1e-3 * random.standard_normal((T, 6))
    state = State(lie.exp_se3(twists), random.uniform(0.3, 2, (T, P)), 1.1 * WIDTH)
    relative = state.cam_from_world[edges[:, 1]] @ lie.inverse(state.cam_from_world)[edges[:, 0]]
    rays = np.concatenate([(base.pixels - base.centre) / state.focal_px, np.ones((P, 1))], axis=1)
    points = np.einsum("eab,pb->epa", relative[:, :3, :3], rays)
    points += state.inverse_depth[edges[:, 0], :, None] * relative[:, None, :3, 3]
    matches = state.focal_px * points[..., :2] / points[..., 2:] + base.centre + 0.3 * random.standard_normal((E, P, 2))
    pointer = np.searchsorted(edges[:, 0], np.arange(T + 1))
    source, target = np.ascontiguousarray(edges[:, 0]), np.ascontiguousarray(edges[:, 1])
    weights = random.uniform(0.5, 1, (E, P)).astype(np.float32)
    data = (source, target, pointer, base.pixels, matches.astype(np.float32), weights)
    return FlowGraph(*data, base.centre, WIDTH, HEIGHT, stride, masked=True), state


def kernel_system(graph: FlowGraph, state: State) -> tuple[np.ndarray, np.ndarray]:
    """The reduced system [6 T + 1, 6 T + 1] and its right-hand side [6 T + 1] by the kernels of `stages.ba`."""
    system = proposal.linear_system(graph, state, SIGMA_PX, Unknowns(focal=True))
    assert isinstance(system, DenseSystem)
    return system.S, system.rhs


def torch_system(graph: FlowGraph, state: State) -> tuple[torch.Tensor, torch.Tensor]:
    """The same system by batched torch operations: Jacobians of all edges, einsum, index_add, dense elimination."""
    T, P = state.inverse_depth.shape
    i, j = torch.from_numpy(graph.source), torch.from_numpy(graph.target)
    relative = reduced.relative_motions(graph, state.cam_from_world)
    Ji, Jj, Jf, Jd, r, w = _torch_jacobians(graph, state, relative)
    H = torch.zeros(T * T, 6, 6, dtype=torch.float64)
    for a, b, first, second in ((i, i, Ji, Ji), (i, j, Ji, Jj), (j, i, Jj, Ji), (j, j, Jj, Jj)):
        H.index_add_(0, a * T + b, torch.einsum("epra,ep,eprb->eab", first, w, second))
    rhs = torch.zeros(6 * T + 1, dtype=torch.float64)
    cross, gradient = torch.zeros(T, 6, dtype=torch.float64), torch.zeros(T, 6, dtype=torch.float64)
    for a, first in ((i, Ji), (j, Jj)):
        cross.index_add_(0, a, torch.einsum("epra,ep,epr->ea", first, w, Jf))
        gradient.index_add_(0, a, torch.einsum("epra,ep,epr->ea", first, w, r))
    S = torch.zeros(6 * T + 1, 6 * T + 1, dtype=torch.float64)
    S[:-1, :-1] = H.view(T, T, 6, 6).transpose(1, 2).reshape(6 * T, 6 * T)
    S[-1, :-1] = S[:-1, -1] = cross.ravel()
    S[-1, -1] = torch.einsum("epr,ep,epr->", Jf, w, Jf)
    rhs[:-1], rhs[-1] = gradient.ravel(), torch.einsum("epr,ep,epr->", Jf, w, r)
    coupling = torch.zeros(T * T, 6, P, dtype=torch.float64)
    coupling.index_add_(0, i * T + i, torch.einsum("epra,ep,epr->eap", Ji, w, Jd))
    coupling.index_add_(0, i * T + j, torch.einsum("epra,ep,epr->eap", Jj, w, Jd))
    depth = torch.zeros(T, 3, P, dtype=torch.float64)
    terms = torch.stack([torch.einsum("epr,ep,epr->ep", Jd, w, other) for other in (Jf, Jd, r)], dim=1)
    depth.index_add_(0, i, terms)
    prior = DEPTH_PRIOR
    full = torch.cat([coupling.view(T, 6 * T, P), depth[:, :1]], dim=1)
    scaled = full / (depth[:, 1:2] + prior)
    g = depth[:, 2] + prior * (1 - torch.from_numpy(state.inverse_depth))
    return S - torch.einsum("tap,tbp->ab", scaled, full), rhs - torch.einsum("tap,tp->a", scaled, g)


def _torch_jacobians(graph: FlowGraph, state: State, relative: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Jacobians by source and target pose [E, P, 2, 6], by log focal length and by inverse depth [E, P, 2]; residuals
    [E, P, 2] and weights [E, P]."""
    f = state.focal_px
    rays = np.concatenate([(graph.pixels - graph.centre) / f, np.ones((len(graph.pixels), 1))], axis=1)
    ray, motion = torch.from_numpy(rays), torch.from_numpy(relative)
    d = torch.from_numpy(state.inverse_depth[graph.source])
    turned = torch.einsum("eab,pb->epa", motion[:, :3, :3], ray)
    X, Y, Z = (turned + d[..., None] * motion[:, None, :3, 3]).unbind(-1)
    u, v, s, zero = X / Z, Y / Z, f / Z, torch.zeros_like(X)
    row_u = torch.stack([s * d, zero, -u * s * d, -f * u * v, f + f * u * u, -f * v], dim=-1)
    row_v = torch.stack([zero, s * d, -v * s * d, -f - f * v * v, f * u * v, f * u], dim=-1)
    Jj = torch.stack([row_u, row_v], dim=2)
    Ji = -torch.einsum("epra,eab->eprb", Jj, torch.from_numpy(lie.adjoint(relative)))
    flat = torch.einsum("eab,pb->epa", motion[:, :3, :2], ray[:, :2])
    Jf = torch.stack([f * u - s * (flat[..., 0] - u * flat[..., 2]), f * v - s * (flat[..., 1] - v * flat[..., 2])], -1)
    t = motion[:, None, :3, 3]
    Jd = torch.stack([s * (t[..., 0] - u * t[..., 2]), s * (t[..., 1] - v * t[..., 2])], dim=-1)
    projected = f * torch.stack([u, v], dim=-1) + torch.from_numpy(graph.centre)
    r = torch.from_numpy(graph.matches).double() - projected
    w = torch.from_numpy(graph.weights).double() / (1 + (r**2).sum(-1) / SIGMA_PX**2) ** 2
    return Ji, Jj, Jf, Jd, r, w


def ceres_problem(graph: FlowGraph, state: State) -> pycolmap.Reconstruction:
    """A reconstruction with a 3-D point per pixel of every source frame, observed at the pixel and at its matches."""
    rec = pycolmap.Reconstruction()
    f, (cx, cy) = state.focal_px, graph.centre + 0.5
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[f, cx, cy], camera_id=1)
    rec.add_camera_with_trivial_rig(camera)
    points2d: list[list[np.ndarray]] = [[] for _ in range(graph.T)]
    tracks: list[tuple[np.ndarray, list[tuple[int, int]]]] = []
    world_from_cam = lie.inverse(state.cam_from_world)
    for i in range(graph.T):
        edges = range(graph.pointer[i], graph.pointer[i + 1])
        for p, pixel in enumerate(graph.pixels):
            seen = [(i, pixel), *((int(graph.target[e]), graph.matches[e, p]) for e in edges)]
            elements = []
            for frame, at in seen:
                elements.append((frame, len(points2d[frame])))
                points2d[frame].append(np.asarray(at, float) + 0.5)
            ray = np.append((pixel - graph.centre) / f, 1.0) / state.inverse_depth[i, p]
            tracks.append((world_from_cam[i, :3, :3] @ ray + world_from_cam[i, :3, 3], elements))
    for k, pose in enumerate(state.cam_from_world):
        image = pycolmap.Image(name=f"{k}", keypoints=np.array(points2d[k]), camera_id=1, image_id=k + 1)
        rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for xyz, elements in tracks:
        track = pycolmap.Track([pycolmap.TrackElement(frame + 1, index) for frame, index in elements])
        rec.add_point3D(xyz, track)
    return rec


def ceres_seconds(graph: FlowGraph, state: State, iterations: int = 3) -> float:
    """Wall seconds of one iteration of Ceres: those of the whole call, over `iterations` and the initial evaluation."""
    rec = ceres_problem(graph, state)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.max_num_iterations = iterations
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in rec.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    began = time.perf_counter()
    pycolmap.create_default_bundle_adjuster(options, config, rec).solve()
    return (time.perf_counter() - began) / (iterations + 1)


def full_step(graph: FlowGraph, state: State) -> Callable[[], object]:
    """A function that computes one proposal of the solver: system, solution, depths."""
    return lambda: proposal.propose(graph, state, SIGMA_PX, 1e-3, Unknowns(focal=True), FocalPrior(state.focal_px))


def main() -> None:
    """Print a line per comparison; fail if a gate is missed."""
    graph, state = random_problem(24, 8)
    S, rhs = kernel_system(graph, state)
    S_torch, rhs_torch = (value.numpy() for value in torch_system(graph, state))
    assert np.abs(S - S_torch).max() < 1e-9 * np.abs(S).max()
    assert np.abs(rhs - rhs_torch).max() < 1e-9 * np.abs(rhs).max()
    works = {"kernel": lambda: kernel_system(graph, state), "torch": lambda: torch_system(graph, state)}
    median = alternated(works, 7)
    ratios = {"torch": median["torch"] / median["kernel"]}
    count = len(graph.source) * len(graph.pixels)
    milliseconds = 1e3 * median["kernel"]
    print(f"system, 24 frames, {count} observations: {milliseconds:.1f} ms, {ratios['torch']:.0f} x torch")

    graph, state = random_problem(24, 16)
    step = alternated({"step": full_step(graph, state)}, 7)["step"]
    ratios["Ceres"] = ceres_seconds(graph, state) / step
    print(f"iteration, 24 frames, {len(graph.pixels)} px: {1e3 * step:.1f} ms, {ratios['Ceres']:.0f} x Ceres")

    counts = (25, 50, 100, 200)
    median = alternated({str(T): full_step(*random_problem(T, 8, (1, 2, 3, 5))) for T in counts}, 3)
    per_frame = {T: 1e3 * median[str(T)] / T for T in counts}
    ratios["growth"] = per_frame[200] / per_frame[25]
    print("ms per frame and iteration: " + ", ".join(f"{T} frames {ms:.2f}" for T, ms in per_frame.items()))
    failed = [name for name in ("torch", "Ceres") if ratios[name] < GATES[name]]
    failed += ["growth"] if ratios["growth"] > GATES["growth"] else []
    if failed:
        raise SystemExit(f"missed: {', '.join(failed)} ({ratios})")


if __name__ == "__main__":
    main()
