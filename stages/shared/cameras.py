"""Pinhole cameras and the camera tables. OpenCV axes, pixel centres at integers, cam_from_world [4, 4]."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared import lie
from stages.shared.artifacts import read_metadata, read_table, refuse_infinite, write_table
from stages.shared.atomic import atomic
from stages.shared.errors import InputError, complete
from stages.shared.log import logger

WITHOUT_POSE = ("failed", "unobserved")
"""Status of frames whose pose was not estimated from matches."""
Posed = tuple[np.ndarray, np.ndarray]
"""One camera: cam_from_world [4, 4] and K [3, 3]."""


@dataclass(frozen=True)
class Cameras:
    """Cameras of T frames.

    Attributes:
        cam_from_world: [T, 4, 4] float64.
        Ks: [T, 3, 3] float64, in pixels of the full-size frame.
        numbers: [T] frame numbers as in the file names.
        covariance: [T, 6, 6] of the left twist [translation (scene units), rotation (rad)], zero where unknown.
        status: [T] "estimated", or what else the pose is ("rotation-only", "failed", "unobserved", ...).
        masks_trusted: [T] bool, whether the adjustment used the mask of each frame.
    """

    cam_from_world: np.ndarray
    Ks: np.ndarray
    numbers: np.ndarray
    covariance: np.ndarray
    status: np.ndarray
    masks_trusted: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Camera centres in the world, [T, 3]."""
        return lie.inverse(self.cam_from_world)[:, :3, 3]

    @property
    def masks_used(self) -> np.ndarray:
        """Whether later stages use the mask of each frame, [T]: if most masks are trusted, only those, otherwise all.

        A mask over nearly all of a single frame is wrong, and the other frames show what moves. If only few are
        trusted, all are used: to model a static part as moving costs little accuracy, the reverse costs much.
        """
        most = self.masks_trusted.mean() > 0.5
        return self.masks_trusted if most else np.ones_like(self.masks_trusted)


def make_cameras(
    cam_from_world: np.ndarray,
    Ks: np.ndarray,
    numbers: np.ndarray,
    covariance: np.ndarray | None = None,
    status: np.ndarray | None = None,
    masks_trusted: np.ndarray | None = None,
) -> Cameras:
    """Cameras; by default with zero covariance, status "estimated" and trusted masks. Ks may be a single [3, 3]."""
    T = len(cam_from_world)
    return Cameras(
        np.asarray(cam_from_world, float),
        np.broadcast_to(Ks, (T, 3, 3)).astype(float),
        np.asarray(numbers, np.int64),
        np.zeros((T, 6, 6)) if covariance is None else covariance,
        np.full(T, "estimated", object) if status is None else np.asarray(status, object),
        np.ones(T, bool) if masks_trusted is None else np.asarray(masks_trusted, bool),
    )


def write_cameras(path: Path, cameras: Cameras, metadata: dict[str, Any] | None = None) -> None:
    """Write `ba/poses.parquet`.

    Columns: frame, qw qx qy qz tx ty tz (cam_from_world), fx fy cx cy (px), covariance, status, masks_trusted.
    """
    quats = lie.quat_from_matrix(cameras.cam_from_world[:, :3, :3])
    columns: dict[str, Any] = {"frame": cameras.numbers}
    columns |= {name: quats[:, k] for k, name in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {name: cameras.cam_from_world[:, k, 3] for k, name in enumerate(("tx", "ty", "tz"))}
    K_entries = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    columns |= {name: cameras.Ks[:, row, column] for name, (row, column) in K_entries.items()}
    columns |= {"covariance": cameras.covariance.reshape(-1, 36), "status": list(cameras.status)}
    columns["masks_trusted"] = cameras.masks_trusted
    units = {"units": "pixels; scene units; covariance of the left twist [translation, rotation rad]"}
    write_table(path, columns, units | (metadata or {}))


def usable_cameras(poses: Path | None, depth: Path | None, instead: str) -> Cameras | None:
    """Cameras of the round before; None in the first round, and, with a warning, if they failed.

    Args:
        depth: that of the same round. instead: what is done without cameras, for the warning.

    Raises:
        InputError: if one of both files is given without the other.
    """
    if (poses is None) != (depth is None):
        raise InputError("--previous-poses", "together with --previous-depth", "only one of them", "give both or none")
    cameras = read_cameras(poses) if poses else None
    if cameras is not None and "failed" in cameras.status:
        logger.warning("the cameras of the round before failed; %s", instead)
        return None
    return cameras


def read_cameras(path: Path) -> Cameras:
    """Read what `write_cameras` wrote.

    Raises:
        InputError: if a column is missing, or holds NaN or infinity.
    """
    table = read_table(path)
    refuse_infinite(path, table)
    with complete(path, "cameras laid out as ba/poses.parquet", "add the column"):
        R = lie.matrix_from_quat(np.stack([table[name] for name in ("qw", "qx", "qy", "qz")], axis=-1))
        t = np.stack([table[name] for name in ("tx", "ty", "tz")], axis=-1)
        Ks = intrinsics(table["fx"], table["fy"], table["cx"], table["cy"])
        covariance = table["covariance"].reshape(-1, 6, 6)
        trusted = table["masks_trusted"].astype(bool)
        return Cameras(lie.from_parts(R, t), Ks, table["frame"], covariance, table["status"], trusted)


def read_readout(path: Path) -> float:
    """Readout of a rolling shutter that the adjustment found with these cameras, in frames; 0 if it found none.

    Cameras from elsewhere have no decision.
    """
    found = read_metadata(path).get("rolling_shutter", {"decision": "not tested"})
    return float(found["readout"]) if found["decision"] == "rolling" else 0.0


def has_pose(cameras: Cameras) -> np.ndarray:
    """Whether each frame [T] has an estimated pose, by its status."""
    return ~np.isin(cameras.status.astype(str), WITHOUT_POSE)


def write_tum(path: Path, cameras: Cameras, stamps: Sequence[float]) -> None:
    """Write world_from_camera as TUM lines: timestamp tx ty tz qx qy qz qw.

    Args:
        stamps: [T] time stamps of the frames: seconds, or their numbers for frames without.
    """
    world_from_cam = lie.inverse(cameras.cam_from_world)
    quats_wxyz = lie.quat_from_matrix(world_from_cam[:, :3, :3])
    rows = np.column_stack([stamps, world_from_cam[:, :3, 3], np.roll(quats_wxyz, -1, axis=1)])
    with atomic(path) as partial:
        partial.write_text("".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows))


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> np.ndarray:
    """K [..., 3, 3] from focal lengths and principal point in pixels."""
    fx, fy, cx, cy = np.broadcast_arrays(*(np.asarray(value, float) for value in (fx, fy, cx, cy)))
    K = np.zeros((*fx.shape, 3, 3))
    K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2], K[..., 2, 2] = fx, fy, cx, cy, 1.0
    return K


def centred_intrinsics(focal_px: float, width: int, height: int) -> np.ndarray:
    """K [3, 3] with one focal length and the principal point at the image centre ((W - 1) / 2, (H - 1) / 2)."""
    return intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def scale_intrinsics(Ks: np.ndarray, factor: float) -> np.ndarray:
    """Ks [..., 3, 3] of the image resized by `factor`: its pixels are those of a grid with a stride of 1 / factor."""
    scaled = np.array(Ks, float)
    scaled[..., :2, :2] *= factor
    scaled[..., :2, 2] = frame_from_grid(scaled[..., :2, 2], factor)
    return scaled


def project(points: np.ndarray, cam_from_world: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] and z-depths [...] of world points [..., 3] in one camera ([4, 4], [3, 3])."""
    xyz = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    uvw = xyz @ K.T
    return uvw[..., :2] / uvw[..., 2:], xyz[..., 2]


def unproject(uv: np.ndarray, depth: np.ndarray, cam_from_world: np.ndarray, K: np.ndarray) -> np.ndarray:
    """World points [..., 3] of pixels [..., 2] at z-depths [...] in one camera ([4, 4], [3, 3])."""
    rays = np.stack([(uv[..., 0] - K[0, 2]) / K[0, 0], (uv[..., 1] - K[1, 2]) / K[1, 1], np.ones_like(depth)], axis=-1)
    return np.asarray((rays * depth[..., None] - cam_from_world[:3, 3]) @ cam_from_world[:3, :3])


def projection(source: Posed, target: Posed) -> tuple[np.ndarray, np.ndarray]:
    """A [..., 3, 3] and b [..., 3]: pixel p of `source` at inverse depth d projects to A p + d b in `target`.

    Pixels are homogeneous; A = K_j R_ij K_i^-1 and b = K_j t_ij. For a rotation about the centre b is zero. Cameras may
    be stacked: cam_from_world [..., 4, 4] and K [..., 3, 3].
    """
    (cam_from_world, K), (other_from_world, other_K) = source, target
    relative = other_from_world @ lie.inverse(cam_from_world)
    return other_K @ relative[..., :3, :3] @ np.linalg.inv(K), (other_K @ relative[..., :3, 3:])[..., 0]


def static_flow(
    uv: np.ndarray, inverse_depth: np.ndarray, A: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flow [..., 2] px of a static scene at pixels uv [..., 2], and the ratio [...] of target to source z-depth.

    If this ratio is not positive, the point is not in front of the target camera and its flow is meaningless.

    Args:
        inverse_depth: [...] 1 / z-depth of the pixels, zero at infinity. A: [3, 3] and b: [3] of `projection`.
    """
    there = uv @ A[:, :2].T + A[:, 2] + inverse_depth[..., None] * b
    with np.errstate(divide="ignore", invalid="ignore"):
        return there[..., :2] / there[..., 2:] - uv, there[..., 2]


def pixel_grid(height: int, width: int) -> np.ndarray:
    """Pixel coordinates (u, v) [H, W, 2] float64."""
    v, u = np.mgrid[:height, :width]
    return np.stack([u, v], axis=-1).astype(float)


def frame_from_grid(uv: np.ndarray, stride_px: float) -> np.ndarray:
    """Convert pixel coordinates of a grid over a frame (any shape) to those of the frame: k to s k + (s - 1) / 2.

    Pixel centres are at integers, and both the grid and the frame begin at -0.5.

    Args:
        stride_px: s, frame pixels per grid pixel. It need not be an integer: it is 1.67 for a frame of 854 px and a
            grid of 512. The stride of the flow grid is 1 / scale.
    """
    return uv * stride_px + (stride_px - 1) / 2


def grid_from_frame(uv: np.ndarray, stride_px: float) -> np.ndarray:
    """Convert pixel coordinates of a frame to those of a grid over it; the inverse of `frame_from_grid`."""
    return (uv - (stride_px - 1) / 2) / stride_px
