"""LPIPS (Zhang et al., CVPR 2018), version 0.1 on AlexNet, with weights that the user gives as a file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.shared.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

Distance = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]
"""Of two images [H, W, 3] uint8, over the pixels where a region [H, W] bool is true, over all if it is None."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
LAYERS = (  # name, shape of the kernel, stride, padding, pooled before
    ("net.slice1.0", (64, 3, 11, 11), 4, 2, False),
    ("net.slice2.3", (192, 64, 5, 5), 1, 2, True),
    ("net.slice3.6", (384, 192, 3, 3), 1, 1, True),
    ("net.slice4.8", (256, 384, 3, 3), 1, 1, False),
    ("net.slice5.10", (256, 256, 3, 3), 1, 1, False),
)
EPSILON = 1e-10
PROTOCOL = (
    "LPIPS: version 0.1, AlexNet, on whole images in -1..1; of a region the mean of each layer over its share of the "
    "layer's pixels"
)
SAVED_BY = "write the state_dict() of lpips.LPIPS(net='alex') by torch, as config.yaml shows"


def load_lpips(path: Path) -> Distance:
    """The distance (0: equal) of two images [H, W, 3] uint8, at least 31 pixels each way.

    Args:
        path: the state dict of `lpips.LPIPS(net="alex")`, as torch saves it.

    Raises:
        InputError: if the file is no such state dict.
    """
    import torch

    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # many kinds of errors, one for each way in which a file is no state dict
        found = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(path, "a state dict that torch saved", found, SAVED_BY) from error
    _check(path, weights)
    return lambda image, truth, region: _distance(weights, image, truth, region)


def _check(path: Path, weights: object) -> None:
    import torch

    if not isinstance(weights, dict):
        raise InputError(path, "a dict of tensors", type(weights).__name__, SAVED_BY)
    for k, (name, shape, *_) in enumerate(LAYERS):
        expected = {f"{name}.weight": shape, f"{name}.bias": shape[:1], f"lin{k}.model.1.weight": (1, shape[0], 1, 1)}
        for key, size in expected.items():
            tensor = weights.get(key)
            if not isinstance(tensor, torch.Tensor):
                raise InputError(path, f"the tensor '{key}'", "none of this name", SAVED_BY)
            if tuple(tensor.shape) != size or not bool(torch.isfinite(tensor).all()):
                raise InputError(path, f"finite '{key}' of shape {size}", f"shape {tuple(tensor.shape)}", SAVED_BY)


def _distance(
    weights: "Mapping[str, Tensor]", image: np.ndarray, truth: np.ndarray, region: np.ndarray | None
) -> float:
    """Sum over layers of the mean over pixels of the weighted squared difference of unit features (eq. 1)."""
    import cv2
    import torch

    with torch.inference_mode():
        maps = _features(weights, np.stack([image, truth]))
        total = 0.0
        for k, features in enumerate(maps):
            unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + EPSILON)
            weight = weights[f"lin{k}.model.1.weight"].to(unit.dtype)
            difference = ((unit[:1] - unit[1:]).square() * weight).sum(dim=1)[0]
            if region is None:
                total += float(difference.mean())
                continue
            share = cv2.resize(region.astype(np.float32), difference.shape[::-1], interpolation=cv2.INTER_AREA)
            total += float(np.average(difference.numpy(), weights=share))
    return total


def _features(weights: "Mapping[str, Tensor]", images: np.ndarray) -> "list[Tensor]":
    """AlexNet's five activations [n, C, h, w] of images [n, H, W, 3] uint8."""
    import torch
    from torch.nn import functional

    shift, scale = (torch.tensor(v)[None, :, None, None] for v in (SHIFT, SCALE))
    x = (torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1 - shift) / scale
    maps = []
    for name, _, stride, padding, pooled in LAYERS:
        x = functional.max_pool2d(x, kernel_size=3, stride=2) if pooled else x
        kernel, bias = weights[f"{name}.weight"].float(), weights[f"{name}.bias"].float()
        x = functional.conv2d(x, kernel, bias, stride=stride, padding=padding).relu()
        maps.append(x)
    return maps
