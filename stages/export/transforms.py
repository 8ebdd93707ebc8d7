"""transforms.json and initial points, as nerfstudio reads them (https://docs.nerf.studio/quickstart/data_conventions.html)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.conventions import half_integer_centres, world_from_opengl


def transforms(
    files: Sequence[dict[str, Any]], width: int, height: int, cam_from_world: np.ndarray, Ks: np.ndarray
) -> dict[str, Any]:
    """The content of transforms.json.

    Args:
        files: of each of T frames its `file_path` and what else is known of it. width, height: px.
        cam_from_world: [T, 4, 4]. Ks: [T, 3, 3] px, pixel centres at integers. Cameras that all frames share stand at
            the top, others with each frame.
    """
    cameras = [
        {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
        for K in half_integer_centres(Ks)
    ]
    shared = all(camera == cameras[0] for camera in cameras)
    poses = world_from_opengl(cam_from_world).tolist()
    frames = [
        {**file, **({} if shared else camera), "transform_matrix": pose}
        for file, camera, pose in zip(files, cameras, poses, strict=True)
    ]
    return {"camera_model": "OPENCV", "w": width, "h": height, **(cameras[0] if shared else {}), "frames": frames}


def write_points(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
    """Write points [N, 3] with colours [N, 3] uint8 as a binary PLY: float32 x y z, uchar red green blue."""
    fields = [*((name, "<f4", "float") for name in "xyz"), *((c, "u1", "uchar") for c in ("red", "green", "blue"))]
    table = np.empty(len(xyz), [(name, kind) for name, kind, _ in fields])
    for k, name in enumerate("xyz"):
        table[name] = xyz[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        table[name] = rgb[:, k]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property {word} {name}" for name, _, word in fields] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes())
