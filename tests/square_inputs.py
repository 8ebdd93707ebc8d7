"""Exact inputs of scene and control: the wall with a moving square, whole or with its held-out frame poisoned."""

from pathlib import Path

import finished_run as clip
import numpy as np

from stages.scene.observed import Observed
from stages.shared.artifacts import write_dense, write_json
from stages.shared.cameras import make_cameras, pixel_grid, write_cameras
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json

HELD_OUT = 4
STRIDE = 4


def observe(rgb: np.ndarray | None = None, dynamic: np.ndarray | None = None) -> Observed:
    """The wall and its square, all frames, exact flow between neighbours, with other colours or masks if given."""
    T = clip.T
    pairs = [(i, j) for i in range(T) for j in range(T) if 0 < abs(i - j) <= 2]
    points = [clip.wall(k)[0] for k in range(T)]
    colours = np.stack([clip.picture(k) for k in range(T)]).astype(np.float32) / 255
    masks = np.stack([clip.moving(points[k], k) for k in range(T)])
    flow = np.stack([clip.flow(i, j) for i, j in pairs]).astype(np.float32)
    return Observed(
        rgb=colours if rgb is None else rgb.astype(np.float32),
        dynamic=masks if dynamic is None else dynamic,
        instances=(masks if dynamic is None else dynamic).astype(np.uint16),
        depth=np.stack([clip.wall(k)[1] for k in range(T)]),
        cam_from_world=clip.CAM_FROM_WORLD,
        Ks=np.broadcast_to(clip.K, (T, 3, 3)),
        edges=np.array(pairs),
        flow=flow,
        confidence=np.ones(flow.shape[:3], np.float32),
        offsets=np.array([j - i for i, j in pairs]),
    )


def write_inputs(folder: Path, poison: bool = False, motion: bool = True) -> dict[str, Path]:
    """Write what the two stages read, by flag name. `poison` spoils all of the held-out frame.

    Without `motion` the masks are empty and the flow is that of the wall alone.
    """
    frames = clip.write_dataset(folder / "data", truth=False)
    points = [clip.wall(k)[0] for k in range(clip.T)]
    masks = [clip.moving(points[k], k) & motion for k in range(clip.T)]
    pairs = [(i, j) for i in range(clip.T) for j in range(clip.T) if 0 < abs(i - j) <= 2]
    flows = np.stack([clip.flow(i, j) if motion else wall_flow(i, j) for i, j in pairs])
    depth = np.stack([clip.wall(k)[1] for k in range(clip.T)])
    if poison:
        masks[HELD_OUT] = ~masks[HELD_OUT]
        flows[[HELD_OUT in pair for pair in pairs]] = 3.0
        depth[HELD_OUT] *= 0.5
        write_image(frames / f"frame_{HELD_OUT + 1:04d}.png", np.zeros((clip.H, clip.W, 3), np.uint8))
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("wall", frames)))
    source, target = np.array(pairs).T
    columns = {"source": source, "target": target, "flow": flows.astype(np.float16)}
    columns["confidence"] = np.ones(flows.shape[:3], np.float16)
    write_dense(folder / "pairs.arrow", columns, {"width": clip.W, "height": clip.H, "scale": 1.0})
    for k, mask in enumerate(masks):
        write_image(folder / "masks" / f"frame_{k + 1:04d}.png", mask)
    numbers = np.arange(1, clip.T + 1)
    write_cameras(folder / "poses.parquet", make_cameras(clip.CAM_FROM_WORLD, clip.K, numbers))
    write_depth(folder / "depth.arrow", depth, np.stack(masks))
    names = ("pairs.arrow", "masks", "poses.parquet", "depth.arrow")
    paths = {flag: folder / name for flag, name in zip(("flow", "masks", "poses", "depth"), names, strict=True)}
    return {"sequence": folder / "sequence.json"} | paths


def write_depth(path: Path, depth: np.ndarray, masks: np.ndarray) -> None:
    """The solver's depth: exact on the wall, the wall's with a large variance in the square."""
    nearest = (pixel_grid(clip.H // STRIDE, clip.W // STRIDE) * STRIDE + (STRIDE - 1) / 2).round().astype(int)
    u, v = nearest[..., 0], nearest[..., 1]
    inverse, filled = (1 / depth[:, v, u]).astype(np.float32), masks[:, v, u]
    variance = (inverse * np.where(filled, 0.5, 0.01)) ** 2
    columns = {"frame": np.arange(1, len(depth) + 1), "inverse_depth": inverse, "filled": filled.astype(np.uint8)}
    write_dense(path, columns | {"variance": variance.astype(np.float32)}, {"stride_px": STRIDE})


def wall_flow(i: int, j: int) -> np.ndarray:
    """Exact flow [H, W, 2] of the wall without the square."""
    points, _ = clip.wall(i)
    return clip.project(points, clip.CAM_FROM_WORLD[j], clip.K)[0] - pixel_grid(clip.H, clip.W)
