"""Analytic scenes with exact depth, flow and masks: a room of planes seen by a moving camera, and a moving disc.

The room is axis-aligned: every pixel's depth is the nearest positive intersection of its ray with the planes, in
closed form. The disc faces the world's z axis and moves by a constant velocity per frame.
"""

from dataclasses import dataclass

import numpy as np

from stages.ba import reduced
from stages.ba.dense_system import DenseSystem
from stages.ba.graph import FlowGraph, build_graph, static_areas
from stages.ba.weights import mask_graph
from stages.shared import lie
from stages.shared.cameras import centred_intrinsics, pixel_grid, project, unproject
from stages.shared.lens import distort, undistort

OFFSETS = (1, 2, 3)
ROOM = (
    ((0.0, 1.0, 0.0), 1.0),
    ((0.0, -1.0, 0.0), 1.5),
    ((1.0, 0.0, 0.0), 2.0),
    ((-1.0, 0.0, 0.0), 2.5),
    ((0.2, 0.0, 1.0), 6.0),
    ((-0.5, 0.1, 1.0), 5.0),
)
"""Planes n . X = distance: floor, ceiling, walls, and two slanted back walls."""
PLANE = (((0.3, -0.2, 1.0), 4.0),)
"""A scene of one slanted plane."""


@dataclass(frozen=True)
class Scene:
    """Exact truth of T frames of h x w px.

    Attributes:
        cam_from_world: [T, 4, 4]; K: [3, 3]; depth: [T, h, w]; dynamic: [T, h, w] bool, pixels on the disc.
        velocity: [3] of the disc per frame.
        zoom: [T] focal length of every frame over that of K; None: all have K.
        lens: k1 and k2 [2] of its radial distortion; None: a pinhole.
    """

    cam_from_world: np.ndarray
    K: np.ndarray
    depth: np.ndarray
    dynamic: np.ndarray
    velocity: np.ndarray
    zoom: np.ndarray | None = None
    lens: np.ndarray | None = None

    @property
    def T(self) -> int:
        """Number of frames."""
        return len(self.cam_from_world)

    @property
    def focal_px(self) -> float:
        """Focal length."""
        return float(self.K[0, 0])

    def K_of(self, k: int) -> np.ndarray:
        """K [3, 3] of one frame."""
        ratio = 1.0 if self.zoom is None else self.zoom[k]
        return np.asarray(self.K * [[ratio, 1, 1], [1, ratio, 1], [1, 1, 1]])

    def pinhole(self, pixels: np.ndarray, k: int) -> np.ndarray:
        """The pixels [..., 2] of frame k without the distortion."""
        if self.lens is None:
            return pixels
        focal, centre = self.K_of(k)[0, 0], self.K[:2, 2]
        return centre + focal * undistort((pixels - centre) / focal, self.lens)

    def pictured(self, pixels: np.ndarray, k: int) -> np.ndarray:
        """Where pixels [..., 2] of a pinhole are in frame k."""
        if self.lens is None:
            return pixels
        focal, centre = self.K_of(k)[0, 0], self.K[:2, 2]
        return centre + focal * distort((pixels - centre) / focal, self.lens)


def painted(dynamic: np.ndarray) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 in which the pixels `dynamic` [T, h, w] are red and all others grey."""
    return np.where(dynamic[..., None], (200, 40, 40), (120, 120, 120)).astype(np.uint8)


def make_scene(
    T: int = 8,
    size: tuple[int, int] = (64, 96),
    motion: str = "curve",
    planes: tuple = ROOM,
    disc_radius: float = 0.0,
    scale: float = 1.0,
    focal: float = 0.9,
    travel: float = 1.0,
    path: np.ndarray | None = None,
    zoom: np.ndarray | None = None,
    K: np.ndarray | None = None,
    lens: np.ndarray | None = None,
    velocity: tuple[float, float, float] = (0.12, 0.02, 0.0),
) -> Scene:
    """A scene of (h, w) px.

    Args:
        motion: "curve" (translation and rotation), "rotate", "still" (3 % of the curve), or "drift" (mostly turning).
        disc_radius: radius of the moving disc at depth 2.5; 0 for a static scene.
        scale: unit of length of the world; focal: focal length in image widths; travel: share of the translation.
        path: poses [T, 4, 4] instead of those of `motion`; zoom: [T], lens: [2], as in `Scene`; K: [3, 3] instead of
            that of `focal`; velocity: of the disc, per frame.
    """
    h, w = size
    K = centred_intrinsics(focal * w, w, h) if K is None else K
    cam_from_world = camera_path(T, motion, travel) if path is None else path
    moved = np.array(velocity) if disc_radius else np.zeros(3)
    depth, dynamic = np.zeros((T, h, w)), np.zeros((T, h, w), bool)
    scene = Scene(cam_from_world, K, depth, dynamic, moved, zoom, lens)
    for k in range(T):
        pixels = scene.pinhole(pixel_grid(h, w), k)
        depth[k] = _plane_depth(cam_from_world[k], scene.K_of(k), pixels, planes)
        if disc_radius:
            middle = moved * k + [-0.4, 0.2, 2.5]
            disc = _disc_depth(cam_from_world[k], scene.K_of(k), pixels, middle, disc_radius)
            dynamic[k] = disc < depth[k]
            depth[k] = np.minimum(depth[k], disc)
    cam_from_world = cam_from_world.copy()
    cam_from_world[:, :3, 3] *= scale
    return Scene(cam_from_world, K, depth * scale, dynamic, moved * scale, zoom, lens)


def camera_path(T: int, motion: str, travel: float = 1.0) -> np.ndarray:
    """Poses [T, 4, 4]; the first is the identity."""
    time = np.arange(T)[:, None]
    if motion == "rotate":
        twists = time * np.array([0, 0, 0, 0.002, 0.02, 0.001]) + np.sin(time * 0.7) * [0, 0, 0, 0.01, 0, 0.002]
    elif motion == "drift":
        twists = time * np.array([-0.01, 0.0016, -0.0065, 0.0008, -0.016, 0.0005])
    else:
        size = 0.03 if motion == "still" else 1.0
        straight = time * np.array([-0.15, 0.03, -0.1, 0.003, -0.012, 0.002])
        bend = (1 - np.cos(time * 0.3)) * [0.1, 0.08, 0.05, 0.004, -0.02, -0.004]
        twists = size * (straight + bend)
    return lie.exp_se3(twists * np.repeat([travel, 1.0], 3))


def exact_flow(scene: Scene, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow [h, w, 2] px from frame i to j, and where its target lies in the image and in front [h, w] bool."""
    h, w = scene.depth.shape[1:]
    pixels = pixel_grid(h, w)
    world = unproject(scene.pinhole(pixels, i), scene.depth[i], scene.cam_from_world[i], scene.K_of(i))
    world = world + scene.dynamic[i][..., None] * scene.velocity * (j - i)
    target, z = project(world, scene.cam_from_world[j], scene.K_of(j))
    target = scene.pictured(target, j)
    inside = (target >= 0).all(-1) & (target[..., 0] <= w - 1) & (target[..., 1] <= h - 1) & (z > 0)
    return target - pixels, inside & _is_visible(scene, j, target, z)


def observe(
    scene: Scene,
    offsets: tuple[int, ...] = OFFSETS,
    stride: int = 4,
    masked: bool = True,
    noise_px: float = 0.0,
    seed: int = 0,
) -> FlowGraph:
    """The graph of exact flow (float32) with Gaussian noise and confidence 1 where visible, masked by the truth."""
    rng = np.random.default_rng(seed)
    source, target, flow, confidence = flow_arrays(scene, offsets)
    flow = flow + noise_px * rng.standard_normal(flow.shape).astype(np.float32)
    graph = build_graph(source, target, flow, confidence, scene.T, stride)
    if not masked:
        return graph
    return mask_graph(graph, static_areas(scene.dynamic, graph.width, graph.height, margin_px=1))


def flow_arrays(scene: Scene, offsets: tuple[int, ...] = OFFSETS) -> tuple[np.ndarray, ...]:
    """source [E], target [E], flow [E, h, w, 2] float32 and confidence [E, h, w] float32 of exact flow."""
    edges = sorted((i, j) for i in range(scene.T) for j in range(scene.T) if abs(i - j) in offsets)
    flow, visible = zip(*(exact_flow(scene, i, j) for i, j in edges), strict=True)
    source, target = np.array(edges).T
    return source, target, np.stack(flow).astype(np.float32), np.stack(visible).astype(np.float32)


def trajectory_error(cam_from_world: np.ndarray, truth: np.ndarray) -> float:
    """RMSE of the camera centres after similarity alignment, over the length of the true path (1 = all of it)."""
    a, b = lie.inverse(cam_from_world)[:, :3, 3], lie.inverse(truth)[:, :3, 3]
    length = np.linalg.norm(np.diff(b, axis=0), axis=1).sum()
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, singular, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    aligned = (singular * signs).sum() / (a**2).sum() * a @ (U * signs @ Vt).T
    return float(np.sqrt(((aligned - b) ** 2).sum(axis=1).mean()) / length)


def assembled(
    graph: FlowGraph, relative: np.ndarray, hessians: np.ndarray, schur: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The sum S [n, n] of the local systems of all frames, and its right-hand side [n]."""
    terms = list(reduced.frame_terms(graph, relative, hessians, schur))
    size = 1 + max(int(term.unknowns.max()) for term in terms)
    system = DenseSystem(size, np.arange(size))
    for term in terms:
        system.add(term)
    return system.S, system.rhs


def rotation_error_deg(cam_from_world: np.ndarray, truth: np.ndarray) -> float:
    """RMS angle between the estimated and the true rotations from frame to frame."""
    steps = [poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2) for poses in (cam_from_world, truth)]
    angles = np.linalg.norm(lie.log_so3(np.swapaxes(steps[0], 1, 2) @ steps[1]), axis=1)
    return float(np.degrees(np.sqrt((angles**2).mean())))


def _rays(cam_from_world: np.ndarray, K: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World directions [h, w, 3] of the pixels, with z-depth 1 in the camera, and the camera centre [3]."""
    centre = lie.inverse(cam_from_world)[:3, 3]
    return unproject(pixels, np.ones(pixels.shape[:2]), cam_from_world, K) - centre, centre


def _plane_depth(cam_from_world: np.ndarray, K: np.ndarray, pixels: np.ndarray, planes: tuple) -> np.ndarray:
    directions, centre = _rays(cam_from_world, K, pixels)
    depth = np.full(pixels.shape[:2], np.inf)
    for normal, distance in planes:
        with np.errstate(divide="ignore"):
            hit = (distance - centre @ normal) / (directions @ normal)
        depth = np.where((hit > 0) & (hit < depth), hit, depth)
    return depth


def _disc_depth(
    cam_from_world: np.ndarray, K: np.ndarray, pixels: np.ndarray, middle: np.ndarray, radius: float
) -> np.ndarray:
    directions, centre = _rays(cam_from_world, K, pixels)
    hit = (middle[2] - centre[2]) / directions[..., 2]
    points = centre + hit[..., None] * directions
    return np.where((np.linalg.norm(points - middle, axis=-1) < radius) & (hit > 0), hit, np.inf)


def _is_visible(scene: Scene, j: int, target: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether no nearer surface hides the points in frame j (nearest pixel, 5 % tolerance)."""
    h, w = scene.depth.shape[1:]
    u = np.clip(np.rint(target[..., 0]), 0, w - 1).astype(int)
    v = np.clip(np.rint(target[..., 1]), 0, h - 1).astype(int)
    return z < 1.05 * scene.depth[j][v, u]
