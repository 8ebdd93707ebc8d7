"""Binary PLY of Gaussian splats in the layout of Kerbl et al. 2023, which viewers read; no other PLY is read.

Fields in order: x y z, f_dc_0..2, f_rest_* (channel-major: all coefficients of red, then green, then blue), opacity
(logit), scale_0..2 (natural logarithm), rot_0..3 (wxyz). All float32, little-endian.
"""

from pathlib import Path

import numpy as np

from stages.shared.atomic import atomic
from stages.shared.errors import InputError


def write_ply(
    path: Path, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray
) -> None:
    """Write N Gaussians: means [N, 3], quats wxyz [N, 4] of any length, log_scales [N, 3], logits [N], sh [N, K, 3]."""
    N = len(means)
    unit = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(N, 3 * (sh.shape[1] - 1))
    table = np.concatenate([means, sh[:, 0], rest, logits[:, None], log_scales, unit], axis=1, dtype="<f4")
    names = _field_names(rest.shape[1])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {N}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with atomic(path) as partial:
        partial.write_bytes("\n".join(header).encode() + np.ascontiguousarray(table).tobytes())


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Read means [N, 3], quats [N, 4], log_scales [N, 3], logits [N] and sh [N, K, 3], float32, as in `write_ply`.

    Raises:
        InputError: if the file has another layout or is truncated.
    """
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    rest = len(names) - len(_field_names(0))
    if not mark or lines[:2] != ["ply", "format binary_little_endian 1.0"] or names != _field_names(rest):
        raise InputError(path, "a binary PLY of Gaussian splats", "another header", "export the splats again")
    N = int(lines[2].split()[-1])
    if len(body) != 4 * N * len(names):
        raise InputError(path, f"{4 * N * len(names)} bytes of data", f"{len(body)}", "export the splats again")
    table = np.frombuffer(body, "<f4").reshape(N, len(names))
    means, dc, tail, logits, log_scales, quats = np.split(table, np.cumsum([3, 3, rest, 1, 3]), axis=1)
    sh = np.concatenate([dc[:, None], tail.reshape(N, 3, rest // 3).transpose(0, 2, 1)], axis=1)
    return means, quats, log_scales, logits[:, 0], sh


def _field_names(rest: int) -> list[str]:
    return [
        *"xyz",
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(rest)),
        "opacity",
        *(f"scale_{k}" for k in range(3)),
        *(f"rot_{k}" for k in range(4)),
    ]
