"""LPIPS against the same formula written out in numpy, and files that are no weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from stages.configuration import config as configuration
from stages.evaluate.lpips import load_lpips
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.score_images import score_images
from stages.shared.artifacts import Dense
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.sequences import Sequence

CHANNELS = (3, 64, 192, 384, 256, 256)
KERNELS = (11, 5, 3, 3, 3)
NAMES = ("slice1.0", "slice2.3", "slice3.6", "slice4.8", "slice5.10")


def _weights() -> dict[str, torch.Tensor]:
    """Random weights under the names of the original package."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for k, name in enumerate(NAMES):
        size = (CHANNELS[k + 1], CHANNELS[k], KERNELS[k], KERNELS[k])
        found[f"net.{name}.weight"] = torch.randn(size, generator=generator) / np.sqrt(np.prod(size[1:]))
        found[f"net.{name}.bias"] = 0.1 * torch.randn(size[0], generator=generator)
        found[f"lin{k}.model.1.weight"] = torch.rand((1, size[0], 1, 1), generator=generator)
    return found


def _windows(x: np.ndarray, size: int, stride: int) -> np.ndarray:
    """Windows [C, h, w, size, size] of x [C, H, W]."""
    return sliding_window_view(x, (size, size), axis=(1, 2))[:, ::stride, ::stride]


def _oracle(weights: dict[str, torch.Tensor], images: list[np.ndarray], columns: int | None = None) -> float:
    """Of the whole images, or of so many of their first columns: of a pixel of a layer the share that these cover."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, y = (np.moveaxis((image / 255 * 2 - 1 - shift) / scale, -1, 0) for image in images)
    total = 0.0
    for k, name in enumerate(NAMES):
        kernel, bias = (weights[f"net.{name}.{part}"].double().numpy() for part in ("weight", "bias"))
        pad, stride = ((2, 4), (2, 1), (1, 1), (1, 1), (1, 1))[k]
        maps = []
        for z in (x, y):
            pooled = _windows(z, 3, 2).max(axis=(-2, -1)) if k in (1, 2) else z
            padded = np.pad(pooled, ((0, 0), (pad, pad), (pad, pad)))
            found = np.einsum("chwij,ocij->ohw", _windows(padded, kernel.shape[-1], stride), kernel, optimize=True)
            maps.append(np.maximum(found + bias[:, None, None], 0))
        x, y = maps
        unit_x, unit_y = (z / (np.linalg.norm(z, axis=0) + 1e-10) for z in (x, y))
        weight = weights[f"lin{k}.model.1.weight"].double().numpy().ravel()
        difference = np.einsum("c,chw->hw", weight, (unit_x - unit_y) ** 2)
        width = images[0].shape[1] / difference.shape[1]  # of a pixel of the layer
        first = np.arange(difference.shape[1]) * width
        share = np.ones_like(first) if columns is None else ((columns - first) / width).clip(0, 1)
        total += float((difference * share).sum() / (len(difference) * share.sum()))
    return total


def test_distance_is_the_formula(tmp_path: Path) -> None:
    weights = _weights()
    torch.save(weights, tmp_path / "alex.pth")
    distance = load_lpips(tmp_path / "alex.pth")
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (47, 61, 3), dtype=np.uint8)
    other = np.clip(image + rng.normal(0, 30, image.shape), 0, 255).astype(np.uint8)
    assert distance(image, other, None) == pytest.approx(_oracle(weights, [image, other]), rel=1e-4)
    assert distance(image, other, np.ones((47, 61), bool)) == pytest.approx(distance(image, other, None), rel=1e-5)
    left = np.broadcast_to(np.arange(61) < 25, (47, 61))
    assert distance(image, other, left) == pytest.approx(_oracle(weights, [image, other], 25), rel=1e-4)
    assert distance(image, image, None) == 0


def test_files_that_are_no_weights_are_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "alex.pth"
    path.write_bytes(b"not a zip")
    with pytest.raises(InputError, match="a state dict that torch saved"):
        load_lpips(path)
    torch.save([1, 2], path)
    with pytest.raises(InputError, match="a dict of tensors, found list"):
        load_lpips(path)
    weights = _weights()
    torch.save({name: tensor for name, tensor in weights.items() if name != "lin2.model.1.weight"}, path)
    with pytest.raises(InputError, match=r"the tensor 'lin2\.model\.1\.weight'"):
        load_lpips(path)
    torch.save(weights | {"net.slice1.0.weight": torch.zeros(64, 3, 3, 3)}, path)
    with pytest.raises(InputError, match=r"shape \(64, 3, 11, 11\), found shape \(64, 3, 3, 3\)"):
        load_lpips(path)
    torch.save(weights | {"net.slice4.8.bias": torch.full((256,), float("nan"))}, path)
    with pytest.raises(InputError, match="finite"):
        load_lpips(path)


def test_image_rows_carry_lpips_of_all_regions_where_weights_are_given(tmp_path: Path) -> None:
    paths = [tmp_path / f"frame_{number:04d}.png" for number in (1, 2, 3)]
    images = np.random.default_rng(2).integers(0, 256, (3, 40, 48, 3), dtype=np.uint8)
    for path, image in zip(paths, images, strict=True):
        write_image(path, image)
    write_image(tmp_path / "renders/test/frame_0002.png", images[0])
    sequence = Sequence("noise", paths, [1, 2, 3], 48, 40)
    flow = Dense({"source": np.zeros(0, int), "target": np.zeros(0, int), "flow": np.zeros((0, 40, 48, 2))})
    half = np.broadcast_to(np.arange(48) < 24, (40, 48))
    torch.save(_weights(), tmp_path / "alex.pth")
    pair = [images[0], images[1]]
    expected = {"alex.pth": (_oracle(_weights(), pair), _oracle(_weights(), pair, 24)), None: (None, None)}
    for file, (whole, left) in expected.items():
        weights = tmp_path / file if file else None
        options = EvaluateOptions(lpips_weights=weights, holdout_every=3, holdout_first=1)
        rows, _ = score_images(sequence, tmp_path / "renders", flow, ({2: half}, "by hand"), options)
        found = {row["region"]: row["lpips"] for row in rows if row["method"] == "ours"}
        assert found["whole"] == (None if whole is None else pytest.approx(whole, rel=1e-4))
        assert found["dynamic"] == (None if left is None else pytest.approx(left, rel=1e-4))
        assert (found["static"] is None) == (whole is None)


def test_a_missing_file_of_weights_stops_before_any_job() -> None:
    with pytest.raises(InputError, match="lpips_weights: expected an existing file, found"):
        configuration.load({"evaluate": {"lpips_weights": "/nowhere/alex.pth"}})
