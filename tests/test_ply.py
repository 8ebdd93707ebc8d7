"""Splat files: the layout that viewers expect, and that what is written renders the same after reading."""

from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.errors import InputError
from stages.splatting.ply import read_ply, write_ply
from stages.splatting.rasterize import rasterize

N = 40


def gaussians(K: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    means = random.uniform([-1, -1, 2], [1, 1, 4], (N, 3))
    quats, log_scales = 3 * random.normal(size=(N, 4)), random.uniform(-4, -1.5, (N, 3))
    return means, quats, log_scales, random.normal(size=N), 0.4 * random.normal(size=(N, K, 3))


def header_and_body(path: Path) -> tuple[list[str], bytes]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head.decode().splitlines(), body


def test_header_names_the_fields_of_3dgs_and_no_other(tmp_path: Path) -> None:
    write_ply(tmp_path / "splats.ply", *gaussians(K=4))
    lines, body = header_and_body(tmp_path / "splats.ply")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {N}"]
    fields = "x y z f_dc_0 f_dc_1 f_dc_2"
    fields += " f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 f_rest_7 f_rest_8"
    fields += " opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert lines[3:] == [f"property float {name}" for name in fields.split()]
    assert len(body) == 4 * N * 23


def test_values_are_logits_logarithms_wxyz_and_channel_major(tmp_path: Path) -> None:
    means, quats, log_scales, logits, sh = gaussians(K=4)
    write_ply(tmp_path / "splats.ply", means, quats, log_scales, logits, sh)
    row = np.frombuffer(header_and_body(tmp_path / "splats.ply")[1], "<f4")[:23]
    assert np.allclose(row[:3], means[0])
    assert np.allclose(row[3:6], sh[0, 0])
    assert np.allclose(row[6:9], sh[0, 1:, 0])  # all of red before any of green
    assert np.allclose(row[9:12], sh[0, 1:, 1])
    assert np.allclose(row[15], logits[0])
    assert np.allclose(row[16:19], log_scales[0])
    assert np.allclose(row[19:], quats[0] / np.linalg.norm(quats[0]))


@pytest.mark.parametrize("degree", [0, 3])
def test_what_is_read_again_renders_the_same(tmp_path: Path, degree: int) -> None:
    written = gaussians(K=(degree + 1) ** 2)
    write_ply(tmp_path / "splats.ply", *written)

    def render(values: tuple[np.ndarray, ...]) -> torch.Tensor:
        means, quats, log_scales, logits, sh = (torch.tensor(value, dtype=torch.float32) for value in values)
        K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
        camera = (torch.eye(4)[None], K[None], 64, 48)
        return rasterize(means, quats, log_scales.exp(), logits.sigmoid(), sh, *camera, sh_degree=degree).colour

    before, after = render(written), render(read_ply(tmp_path / "splats.ply"))
    assert before.max() > 0.1
    assert (before - after).abs().max() < 1e-5


def test_an_empty_scene_is_a_valid_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "none.ply", *(values[:0] for values in gaussians(K=1)))
    assert [len(values) for values in read_ply(tmp_path / "none.ply")] == [0] * 5


def test_foreign_and_truncated_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "splats.ply"
    write_ply(path, *gaussians(K=1))
    content = path.read_bytes()
    path.write_bytes(content[:-5])
    with pytest.raises(InputError, match="bytes of data"):
        read_ply(path)
    path.write_bytes(content.replace(b"rot_3", b"extra"))
    with pytest.raises(InputError, match="another header"):
        read_ply(path)
