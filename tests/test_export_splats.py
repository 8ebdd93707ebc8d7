"""Splats of single frames: what other loaders make of PLY, .spz and transforms.json, from their documentation."""

import gzip
import json
import struct
from pathlib import Path

import export_clip as truth
import numpy as np
import pytest
import torch
from PIL import Image

from stages.export import __main__ as export_stage
from stages.export.options import ExportOptions
from stages.splatting import sh as harmonics
from stages.splatting.ply import read_ply
from stages.splatting.rasterize import rasterize
from stages.splatting.spz import write_spz

RUB_FROM_RDF = np.array([1.0, -1.0, -1.0])
"""OpenGL's axes (right, up, backward) from OpenCV's (right, down, forward)."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Splats of two frames beside transforms.json."""
    folder = tmp_path_factory.mktemp("splats")
    options = ExportOptions(formats=("nerfstudio", "ply", "spz"), splat_frames=(4, 6))
    export_stage.main(**truth.write_clip(folder), output=folder / "export", options=options)
    return folder / "export"


def test_splats_stand_where_they_are_at_the_time_of_their_frame(exported: Path) -> None:
    assert {path.name for path in (exported / "splats").iterdir()} == {
        f"frame_000{n}.{kind}" for n in (4, 6) for kind in ("ply", "spz")
    }
    scene = truth.scene()
    for number in (4, 6):
        means, quats, _ = scene.at(truth.TIMES[number - 1])
        found = read_ply(exported / f"splats/frame_000{number}.ply")
        assert np.allclose(found[0], means.detach(), atol=1e-6)
        unit = torch.nn.functional.normalize(quats, dim=-1).detach().numpy()
        assert np.abs((found[1] * unit).sum(axis=-1)).min() > 1 - 1e-6
    moved = [read_ply(exported / f"splats/frame_000{n}.ply")[0][scene.n_static :] for n in (4, 6)]
    assert np.linalg.norm(moved[1] - moved[0], axis=-1).min() > 0.1


Splats = dict[str, np.ndarray]


def read_spz(path: Path) -> Splats:
    """A .spz of version 3, from the description in its README and the reference decoder's constants."""
    content = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, _, reserved = struct.unpack_from("<IIIBBBB", content)
    assert (magic.to_bytes(4, "little"), version, reserved) == (b"NGSP", 3, 0)
    sizes = [9, 1, 3, 3, 4, 3 * (degree + 1) ** 2 - 3]
    assert len(content) == 16 + count * sum(sizes)
    ends = 16 + count * np.cumsum([0, *sizes])
    parts = [
        np.frombuffer(content, np.uint8)[a : a + count * size].reshape(count, size)
        for a, size in zip(ends, sizes, strict=False)
    ]
    position, alpha, colour, scale, rotation, rest = (part.astype(np.int64) for part in parts)
    triples = position.reshape(count, 3, 3) @ [1, 1 << 8, 1 << 16]
    triples -= (triples >> 23) << 24
    words = rotation @ [1, 1 << 8, 1 << 16, 1 << 24]
    quats = np.array([unpack_quat(int(word)) for word in words]).reshape(count, 4)
    return {
        "means": triples / (1 << bits),
        "opacities": alpha[:, 0] / 255,
        "dc": (colour / 255 - 0.5) / 0.15,
        "log_scales": scale / 16 - 10,
        "quats": quats,
        "rest": ((rest - 128) / 128).reshape(count, sizes[-1] // 3, 3),
        "step": np.array(1 / (1 << bits)),
    }


def unpack_quat(word: int) -> list[float]:
    """x y z w of 32 bits: two for the index of the largest, then a sign and 9 bits each for the others, in order."""
    largest, values = word >> 30, [0.0] * 4
    for k in (3, 2, 1, 0):
        if k != largest:
            values[k] = (-1 if word >> 9 & 1 else 1) * (word & 511) / 511 / 2**0.5
            word >>= 10
    values[largest] = (1 - sum(value**2 for value in values)) ** 0.5
    return values


def compare(found: Splats, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray) -> None:
    """What both versions have, within half a step of each."""
    assert np.abs(found["means"] - means * RUB_FROM_RDF).max() <= found["step"] * 0.51 + 1e-6
    assert np.abs(found["opacities"] - 1 / (1 + np.exp(-logits))).max() <= 0.51 / 255
    assert np.abs(found["log_scales"] - log_scales).max() <= 0.51 / 16
    unit = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    expected = np.concatenate([unit[:, 1:] * RUB_FROM_RDF, unit[:, :1]], axis=1)
    angle = 2 * np.arccos(np.abs((found["quats"] * expected).sum(axis=-1)).clip(0, 1))
    assert np.degrees(angle).max() < 0.25


def test_spz_holds_the_gaussians_of_the_ply(exported: Path) -> None:
    for number in (4, 6):
        means, quats, log_scales, logits, sh = read_ply(exported / f"splats/frame_000{number}.ply")
        found = read_spz(exported / f"splats/frame_000{number}.spz")
        compare(found, means, quats, log_scales, logits)
        assert np.abs(found["dc"] - sh[:, 0]).max() <= 0.51 / (0.15 * 255)
        assert found["step"] < 1e-5


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_has_the_same_colours_from_every_side(tmp_path: Path, degree: int) -> None:
    """A direction and its image in the other axes see the same colour, up to the steps of the coefficients."""
    random, N = np.random.default_rng(degree), 60
    sh = random.uniform(-0.4, 0.4, (N, (degree + 1) ** 2, 3))
    means, quats = random.uniform(-900, 900, (N, 3)), random.normal(size=(N, 4))
    log_scales, logits = random.uniform(-9, 5, (N, 3)), random.normal(size=N)
    write_spz(tmp_path / "x.spz", means, quats, log_scales, logits, sh)
    found = read_spz(tmp_path / "x.spz")
    compare(found, means, quats, log_scales, logits)
    steps = np.repeat([0.01308, 8 / 256, 16 / 256, 16 / 256], [1, 3, 5, 7])[: (degree + 1) ** 2] + 0.5 / 128
    read = np.concatenate([found["dc"][:, None], found["rest"]], axis=1)
    for _ in range(20):
        direction = random.normal(size=3)
        there = direction * RUB_FROM_RDF
        values, turned = (
            harmonics.basis(torch.tensor(d / np.linalg.norm(d))[None], degree)[0].numpy() for d in (direction, there)
        )
        error = np.einsum("k,nkc->nc", values, sh) - np.einsum("k,nkc->nc", turned, read)
        assert np.abs(error).max() <= np.abs(values) @ steps


def test_an_empty_spz_is_a_header(tmp_path: Path) -> None:
    write_spz(
        tmp_path / "none.spz", np.zeros((0, 3)), np.ones((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3))
    )
    assert len(gzip.decompress((tmp_path / "none.spz").read_bytes())) == 16
    assert len(read_spz(tmp_path / "none.spz")["means"]) == 0


def load_as_gsplat_does(folder: Path, k: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Image [H, W, 3], viewmat [1, 4, 4] world-to-camera in OpenCV axes and K [1, 3, 3], from transforms.json."""
    content = json.loads((folder / "transforms.json").read_text())
    frame = content["frames"][k]
    c2w = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
    K = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    image = np.asarray(Image.open(folder / frame["file_path"])) / 255
    return torch.tensor(image).float(), torch.tensor(np.linalg.inv(c2w))[None], torch.tensor(K)[None]


def read_3dgs(path: Path) -> dict[str, torch.Tensor]:
    """Parameters of the Gaussians by the names of their fields, in the layout of the 3DGS code."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))
    rest = np.stack([table[name] for name in names if name.startswith("f_rest")], axis=-1).reshape(
        len(table["x"]), 3, -1
    )
    columns = {
        "means": [table[name] for name in "xyz"],
        "quats": [table[f"rot_{k}"] for k in range(4)],
        "scales": [table[f"scale_{k}"] for k in range(3)],
        "sh_dc": [table[f"f_dc_{k}"] for k in range(3)],
    }
    found = {name: torch.tensor(np.stack(values, axis=-1)) for name, values in columns.items()}
    return found | {
        "opacity": torch.tensor(table["opacity"].copy()),
        "sh_rest": torch.tensor(rest.swapaxes(1, 2).copy()),
    }


def render(splats: dict[str, torch.Tensor], viewmat: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """One image, with gsplat's arguments and its pixel centres at half-integers."""
    ours = K - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # our rasteriser has them at integers
    sh = torch.cat([splats["sh_dc"][:, None], splats["sh_rest"]], dim=1)
    shape = (splats["means"], splats["quats"], splats["scales"].exp(), splats["opacity"].sigmoid())
    grey = torch.full((1, 3), 0.5)
    return rasterize(*shape, sh, viewmat, ours, truth.W, truth.H, sh_degree=1, backgrounds=grey).colour[0]


def test_one_step_of_training_on_what_a_gsplat_loader_reads_lowers_the_loss(exported: Path) -> None:
    splats = read_3dgs(exported / "splats/frame_0004.ply")
    image, viewmat, K = load_as_gsplat_does(exported, 3)
    static = torch.tensor(~truth.mask(3))
    for values in splats.values():
        values.requires_grad_()
    before = (render(splats, viewmat, K) - image)[static].abs().mean()
    before.backward()
    assert before < 0.02
    for pixels in (-2, 2):
        shifted = viewmat.clone()
        shifted[:, 0, 3] += pixels * truth.WALL_Z / truth.K[0, 0]
        assert before < 0.8 * (render(splats, shifted, K) - image)[static].abs().mean()
    with torch.no_grad():
        for values in splats.values():
            assert values.grad is not None
            values -= 1e-3 * values.grad.sign()
        assert (render(splats, viewmat, K) - image)[static].abs().mean() < 0.99 * before
