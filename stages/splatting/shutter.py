"""Pictures taken with an open shutter: the scene at several moments while it is open, averaged in linear light."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.shared import lie
from stages.shared.lanes import LANES
from stages.shared.torch_threads import one_torch_thread
from stages.splatting import shutter_kernels
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.rasterize import Rendering
from stages.splatting.shutter_kernels import DARK, KNEE, POWER, SCALE, SLOPE

SPACING_PX = 3.0
"""Distance between moments, in the image: closer than a drawn Gaussian is wide, whose deviation is at least 0.5 px."""
VISIBLE_PX = 1.0
"""A smear of at most this length is rendered at a single moment."""
MAX_MOMENTS = 5
QUANTILE = 0.95
"""The length of the smear is that of the Gaussian with this rank, among those that rest and among those that move."""


class Moments(NamedTuple):
    """The moments of one picture.

    Attributes:
        times: [S] of the model, 0..1 but for half of the shutter before the first and after the last frame.
        cam_from_world: [S, 4, 4]. Ks: [S, 3, 3] px.
    """

    times: np.ndarray
    cam_from_world: np.ndarray
    Ks: np.ndarray


class Shutter(NamedTuple):
    """How long the shutter is open, and the cameras of all T frames, between which those of other moments lie.

    Attributes:
        open_for: in frames, 0..1. cam_from_world: [T, 4, 4]. Ks: [T, 3, 3] px.
    """

    open_for: float
    cam_from_world: np.ndarray
    Ks: np.ndarray


def instant(time: float, cam_from_world: np.ndarray, K: np.ndarray) -> Moments:
    """A picture at a single moment: time 0..1, [4, 4], [3, 3]."""
    return Moments(np.array([time]), cam_from_world[None], K[None])


def moments(shutter: Shutter, frame: int, count: int) -> Moments:
    """The middles of `count` equal parts of the open time of a frame, 0..T-1, whose own time is its middle.

    Cameras move evenly from each frame to the next along a screw (a geodesic of SE(3)), and on beyond the first and
    the last.
    """
    T, poses = len(shutter.Ks), shutter.cam_from_world
    positions = frame + shutter.open_for * ((np.arange(count) + 0.5) / count - 0.5)
    before = np.clip(np.floor(positions).astype(int), 0, T - 2)
    share = (positions - before)[:, None]
    steps = lie.log_se3(poses[before + 1] @ lie.inverse(poses[before]))
    Ks = shutter.Ks[before] + share[..., None] * (shutter.Ks[before + 1] - shutter.Ks[before])
    return Moments(positions / (T - 1), lie.exp_se3(share * steps) @ poses[before], Ks)


def open_moments(scene: GaussianScene, shutter: Shutter, frame: int, size: tuple[int, int]) -> Moments:
    """As many moments as the smear of a frame, 0..T-1, is long: the frame's own where there is none to see.

    Args:
        size: width and height of the frame in px.
    """
    smear = 2 * smear_px(scene, moments(shutter, frame, 2), size)  # the middles of both halves are half of it apart
    if smear <= VISIBLE_PX:
        return instant(frame / (len(shutter.Ks) - 1), shutter.cam_from_world[frame], shutter.Ks[frame])
    return moments(shutter, frame, min(max(round(smear / SPACING_PX), 2), MAX_MOMENTS))


@torch.no_grad()
def smear_px(scene: GaussianScene, ends: Moments, size: tuple[int, int]) -> float:
    """How far Gaussians in view move in the image between two moments, px: the larger QUANTILE of both kinds."""
    width, height = size
    seen, centres = np.ones(len(scene.anchors), bool), []
    for time, pose, K in zip(*ends, strict=True):
        means = scene.at(float(time))[0].double().cpu().numpy()
        _, rows = scene.opacities_at(float(time))
        if rows is not None:
            seen &= np.isin(np.arange(len(seen)), rows.cpu().numpy())
        xyz = means @ pose[:3, :3].T + pose[:3, 3]
        seen &= xyz[:, 2] > scene.near_plane
        uvw = xyz @ K.T
        centres.append(uvw[:, :2] / np.where(seen, uvw[:, 2], 1.0)[:, None])
        seen &= ((centres[-1] >= 0) & (centres[-1] <= (width - 1, height - 1))).all(axis=1)
    length = np.linalg.norm(centres[1] - centres[0], axis=1)
    moves = np.arange(len(length)) >= scene.n_static
    kinds = seen & ~moves, seen & moves
    return max(float(np.quantile(length[kind], QUANTILE)) if kind.any() else 0.0 for kind in kinds)


def expose(
    scene: GaussianScene,
    picture: Moments,
    width: int,
    height: int,
    detach: bool = False,
    followed: int | None = None,
) -> tuple[Tensor, list[Rendering]]:
    """Colour [H, W, 3] of the picture, and the renderings of the moments that are differentiated.

    Args:
        detach: as in `GaussianScene.render`.
        followed: number of the moment that alone is differentiated, in place of the mean over all of them. The colour
            is the same. Drawn evenly at random, it gives the gradient of any loss without bias, since a loss depends on
            the moments through their mean, which is exact.
    """
    device, S = scene.background.device, len(picture.times)
    colours, views = [], []
    for s, (time, pose, K) in enumerate(zip(*picture, strict=True)):
        with torch.set_grad_enabled(torch.is_grad_enabled() and followed in (None, s)):
            camera = torch.as_tensor(pose, device=device), torch.as_tensor(K, device=device)
            view = scene.render(float(time), *camera, width, height, detach)
        colours.append(view.colour.squeeze(0))  # the gradient of an index would be a copy
        views += [view] if followed in (None, s) else []
    if S == 1:
        return colours[0], views
    average: Tensor = _Average.apply(followed is not None, *colours)  # type: ignore[no-untyped-call]
    return average, views


class _Average(torch.autograd.Function):
    """Display colours of the mean linear radiance of S pictures: by kernels where they are float32 on the CPU.

    Torch's powers take several times as long, and run on one thread here, since their rounding depends on the number of
    threads.
    """

    @staticmethod
    def forward(ctx: Any, only_one: bool, *colours: Tensor) -> Tensor:
        """Colours [H, W, 3] of pictures [H, W, 3]; with `only_one`, its gradient is that of the mean."""
        ctx.share, shape = 1.0 if only_one else 1 / len(colours), colours[0].shape
        ctx.by_kernels = colours[0].device.type == "cpu" and colours[0].dtype == torch.float32
        if ctx.by_kernels:
            rows = _in_lanes(*colours)
            ctx.colours = [row.copy() if w else None for row, w in zip(rows, ctx.needs_input_grad[1:], strict=True)]
            ctx.images = shutter_kernels.average(rows)
            return torch.from_numpy(ctx.images[0][: shape.numel()]).view(shape)
        with one_torch_thread():
            mean = torch.stack([to_linear(colour) for colour in colours]).mean(dim=0)
            ctx.save_for_backward(mean, *colours)
            return to_display(mean)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        g, wanted = ctx.share * gradients[0], ctx.needs_input_grad[1:]
        if ctx.by_kernels:
            (shown, radiance), (by_shown,) = ctx.images, _in_lanes(g)
            rows = (
                None if row is None else shutter_kernels.average_adjoint(row, shown, radiance, by_shown)
                for row in ctx.colours
            )
            return None, *(None if row is None else torch.from_numpy(row[: g.numel()]).view(g.shape) for row in rows)
        mean, *colours = ctx.saved_tensors
        with one_torch_thread():
            by_mean = g * display_slope(mean)
            pairs = zip(colours, wanted, strict=True)
            return None, *(by_mean * linear_slope(colour) if needed else None for colour, needed in pairs)


def _in_lanes(*images: Tensor) -> np.ndarray:
    """The numbers of each image in a row, [S, n], with zeros up to whole vectors."""
    size = images[0].numel()
    rows = np.zeros((len(images), -(-size // LANES) * LANES), np.float32)
    for row, image in zip(rows, images, strict=True):
        row[:size] = image.detach().reshape(-1).numpy()
    return rows


def to_linear(colour: Tensor) -> Tensor:
    """Linear radiance of display colours, both 0..1; colours beyond 0 or 1 continue the curve."""
    power = ((colour.clamp_min(DARK) + SCALE - 1) / SCALE) ** POWER
    return torch.where(colour <= DARK, colour / SLOPE, power)


def linear_slope(colour: Tensor) -> Tensor:
    """Derivative of `to_linear`."""
    power = POWER / SCALE * ((colour.clamp_min(DARK) + SCALE - 1) / SCALE) ** (POWER - 1)
    return torch.where(colour <= DARK, 1 / SLOPE, power)


def to_display(radiance: Tensor) -> Tensor:
    """The inverse of `to_linear`."""
    power = SCALE * radiance.clamp_min(KNEE) ** (1 / POWER) - (SCALE - 1)
    return torch.where(radiance <= KNEE, SLOPE * radiance, power)


def display_slope(radiance: Tensor) -> Tensor:
    """Derivative of `to_display`."""
    power = SCALE / POWER * radiance.clamp_min(KNEE) ** (1 / POWER - 1)
    return torch.where(radiance <= KNEE, SLOPE, power)
