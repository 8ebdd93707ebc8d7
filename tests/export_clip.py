"""A clip with exact cameras, masks, depth and Gaussians to export: a textured wall with a moving square.

The principal point is off the centre, and the focal lengths differ: an export that ignores either is wrong.
"""

import json
import struct
from pathlib import Path

import finished_run as clip
import gaussian_scene
import numpy as np
import torch

from stages.shared.artifacts import write_dense, write_model
from stages.shared.cameras import frame_from_grid, intrinsics, make_cameras, pixel_grid, unproject, write_cameras
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json
from stages.splatting.cloud import Cloud
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import scene_tensors

T, W, H, WALL_Z = clip.T, 96, 64, clip.WALL_Z
STRIDE = 4
K = intrinsics(95.0, 90.0, 45.0, 33.0)
CAM_FROM_WORLD = clip.CAM_FROM_WORLD
TIMES = np.arange(T) / (T - 1)


def wall(uv: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [..., 3] of the wall at pixels uv [..., 2] of frame k, and their z-depth [...]."""
    depth = np.ones(uv.shape[:-1])
    rays = unproject(uv, depth, CAM_FROM_WORLD[k], K) - clip.CENTRES[k]
    depth = (WALL_Z - clip.CENTRES[k, 2]) / rays[..., 2]
    return clip.CENTRES[k] + rays * depth[..., None], depth


def colour(points: np.ndarray) -> np.ndarray:
    """The smooth colour [..., 3] uint8 of the wall at its points [..., 3]."""
    return np.round(255 * gaussian_scene.texture(points[..., 0], points[..., 1], 2)).astype(np.uint8)


def mask(k: int) -> np.ndarray:
    """The moving square in frame k, [H, W] bool."""
    return clip.moving(wall(pixel_grid(H, W), k)[0], k)


def write_clip(
    folder: Path, status: np.ndarray | None = None, Ks: np.ndarray = K, variance: float = 1e-6
) -> dict[str, Path]:
    """Write all that the export reads, by flag name; depth at a quarter of the size, filled under the masks."""
    grid = frame_from_grid(pixel_grid(H // STRIDE, W // STRIDE), STRIDE)
    inverse_depth, filled = [], []
    for k in range(T):
        image = colour(wall(pixel_grid(H, W), k)[0])
        image[mask(k)] = (230, 120, 30)
        write_image(folder / f"frames/frame_{k + 1:04d}.png", image)
        write_image(folder / f"masks/frame_{k + 1:04d}.png", mask(k))
        write_image(folder / f"renders/novel/frame_{k + 1:04d}.png", image[:-1, :-1])
        inverse_depth.append(1 / wall(grid, k)[1])
        filled.append(clip.moving(wall(grid, k)[0], k))
    (folder / "sequence.json").write_text(json.dumps(sequence_to_json(check_sequence("wall", folder / "frames"))))
    write_cameras(folder / "poses.parquet", make_cameras(CAM_FROM_WORLD, Ks, np.arange(1, T + 1), status=status))
    columns = {"frame": np.arange(1, T + 1), "inverse_depth": np.stack(inverse_depth).astype(np.float32)}
    columns |= {"variance": np.full(columns["inverse_depth"].shape, variance, np.float32)}
    write_dense(folder / "depth.arrow", columns | {"filled": np.stack(filled).astype(np.uint8)}, {"stride_px": STRIDE})
    write_model(folder / "model.safetensors", *scene_tensors(scene()))
    files = {"sequence": "sequence.json", "poses": "poses.parquet", "depth": "depth.arrow"}
    files |= {"masks": "masks", "renders": "renders", "model": "model.safetensors"}
    return {name: folder / file for name, file in files.items()}


def scene() -> GaussianScene:
    """Gaussians on every pixel of the wall in frame 4, and some that move with colours that change by view."""
    uv = pixel_grid(H, W)
    points, _ = wall(uv, 3)
    motion = gaussian_scene.true_motion()
    means = torch.tensor(np.concatenate([points.reshape(-1, 3), motion.points.numpy()]), dtype=torch.float32)
    N, generator = len(means), torch.Generator().manual_seed(0)
    sh = 0.1 * torch.randn(N, 4, 3, generator=generator)
    sh[: points[..., 0].size] = 0
    sh[: points[..., 0].size, 0] = torch.tensor((colour(points).reshape(-1, 3) / 255 - 0.5) / 0.28209479).float()
    cloud = Cloud(
        means=means,
        footprints=torch.ones(N),
        log_scales=torch.randn(N, 3, generator=generator) * 0.2 - 3.7,
        quats=torch.randn(N, 4, generator=generator),
        logits=torch.full((N,), 2.0),
        sh=sh,
        dynamic=torch.arange(N) >= points[..., 0].size,
    )
    return GaussianScene(cloud, motion, torch.full((3,), 0.5), near_plane=0.1, neighbours=4)


class Bytes:
    """Little-endian values, one after the other."""

    def __init__(self, content: bytes) -> None:
        """Read from the first byte on."""
        self.content, self.at = content, 0

    def take(self, layout: str) -> list[float]:
        """The next values in the characters of `struct`."""
        values = struct.unpack_from("<" + layout, self.content, self.at)
        self.at += struct.calcsize("<" + layout)
        return list(values)

    def name(self) -> str:
        """Text up to the next zero."""
        end = self.content.index(b"\0", self.at)
        text, self.at = self.content[self.at : end].decode(), end + 1
        return text


Model = tuple[
    dict[int, list[float]], dict[int, tuple[list[float], str, np.ndarray]], dict[int, tuple[list[float], list]]
]
"""Cameras: model or number, size, parameters. Images: pose with camera id, name, rows x y id. Points: values, track."""


def read_binary(folder: Path) -> Model:
    """A COLMAP model, from https://colmap.github.io/format.html."""
    file, cameras = Bytes((folder / "cameras.bin").read_bytes()), {}
    for _ in range(int(file.take("Q")[0])):
        camera, *rest = file.take("iiQQ")
        assert rest[0] == 1, "PINHOLE"
        cameras[int(camera)] = [*rest[1:], *file.take("4d")]
    file, images = Bytes((folder / "images.bin").read_bytes()), {}
    for _ in range(int(file.take("Q")[0])):
        image, *pose = file.take("i7di")
        name, count = file.name(), int(file.take("Q")[0])
        images[int(image)] = (pose, name, np.array([file.take("ddq") for _ in range(count)]).reshape(-1, 3))
    file, points = Bytes((folder / "points3D.bin").read_bytes()), {}
    for _ in range(int(file.take("Q")[0])):
        point, *values = file.take("Q3d3Bd")
        count = int(file.take("Q")[0])
        points[int(point)] = (values, file.take(f"{2 * count}i"))
    return cameras, images, points


def read_text(folder: Path) -> Model:
    """The same from the text files."""
    kinds = ("cameras", "images", "points3D")
    rows = [[line.split() for line in (folder / f"{kind}.txt").read_text().splitlines()[1:]] for kind in kinds]
    assert all(row[1] == "PINHOLE" for row in rows[0])
    cameras = {int(row[0]): [float(word) for word in row[2:]] for row in rows[0]}
    images = {}
    for row, pixels in zip(rows[1][::2], rows[1][1::2], strict=True):
        pose = [float(word) for word in row[1:9]]
        images[int(row[0])] = (pose, row[9], np.array(pixels, float).reshape(-1, 3))
    points = {int(row[0]): ([float(word) for word in row[1:8]], [int(word) for word in row[8:]]) for row in rows[2]}
    return cameras, images, points
