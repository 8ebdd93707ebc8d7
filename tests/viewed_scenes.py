"""Scenes that the viewer's page is to draw as our rasteriser does."""

import gaussian_scene as truth
import numpy as np
import torch
from gaussian_training import TRAIN, new_scene

from stages.deformation.motion_models import TableDeformation
from stages.splatting.atmosphere import Atmosphere
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.pose_table import PoseTable
from stages.splatting.shadows import ShadowTable


def with_every_effect() -> GaussianScene:
    """The wall and the square, with colours by view and over time, shadows, gains, corrected poses and fog."""
    scene, random = new_scene(truth.observations(TRAIN)), torch.manual_seed(0)
    cloud = scene.cloud()
    cloud.sh = torch.cat([cloud.sh[:, :1], 0.15 * torch.randn(len(cloud.sh), 15, 3, generator=random)], dim=1)
    scene.set_cloud(cloud)
    times = torch.tensor(truth.TIMES[TRAIN])
    scene.colours, scene.exposure = ColourTable(times, 16), Exposure(times, 3)
    scene.poses = PoseTable(times, length=3.0)
    scene.colours.table.data = 0.4 * torch.randn(len(times), 16, 3, generator=random)
    scene.exposure.log_gains.data = 0.2 * torch.randn(len(times), 3, generator=random)
    shade(scene, times, torch.randn(len(times), 12, generator=random), random)
    scene.atmosphere = Atmosphere(0.7 / truth.WALL_Z, torch.tensor([0.6, 0.3, 0.9]))
    scene.poses.twists.data = 0.01 * torch.randn(len(times), 6, generator=random)
    return scene


def shade(scene: GaussianScene, times: torch.Tensor, amounts: torch.Tensor, random: torch.Generator) -> None:
    """Shadows around 12 points of the wall, `amounts` [F, 12] of one tint at `times` [F]."""
    points = torch.cat([2 * torch.rand(12, 2, generator=random) - 1, torch.full((12, 1), truth.WALL_Z)], dim=1)
    scene.shadows = ShadowTable(times, points, torch.full((12,), 0.3))
    scene.shadows.table.data = amounts[..., None] * torch.tensor([0.5, 0.4, 0.2])
    scene.bind()


def tumbling(unit: float) -> GaussianScene:
    """Gaussians thin and broad, brief and lasting, that eight points turn by up to a turn; lengths times `unit`."""
    random, N = torch.manual_seed(1), 600
    means = torch.randn(N, 3, generator=random) * 0.6 + torch.tensor([0.0, 0, 3])
    cloud = Cloud(
        means=unit * means,
        footprints=torch.full((N,), 0.05 * unit),
        log_scales=torch.randn(N, 3, generator=random) - 3.0 + np.log(unit),
        quats=torch.randn(N, 4, generator=random),
        logits=2 * torch.randn(N, generator=random),
        sh=torch.randn(N, 4, 3, generator=random) * torch.tensor([1, 0.3, 0.3, 0.3])[:, None],
        dynamic=torch.arange(N) >= 200,
    )
    cloud.births = torch.rand(N, generator=random)
    cloud.log_spans[200:] = torch.log(0.05 + 0.5 * torch.rand(N - 200, generator=random))
    cloud.drifts = 0.1 * unit * torch.randn(N, 3, generator=random)
    points = unit * means[200::20]
    motion = TableDeformation(points, torch.full((len(points),), np.log(0.4 * unit)), torch.tensor(truth.TIMES))
    steps = 0.5 * torch.randn(motion.table.shape, generator=random)
    motion.table.data = steps.cumsum(dim=0) * torch.tensor([1.0, 1, 1, 1, 0.2, 0.2, 0.2])
    return GaussianScene(cloud, motion, torch.tensor([0.1, 0.2, 0.3]), 0.3 * unit, neighbours=8)


def brightening() -> GaussianScene:
    """The wall, parts of which brighten or darken evenly: any moments of them, both ends among them, say all.

    It is seen aslant: of Gaussians equally far away the page may draw another one first.
    """
    scene, random, times = at_rest(), torch.manual_seed(0), torch.tensor(truth.TIMES)
    shade(scene, times, 2 * times[:, None].float() * torch.randn(12, generator=random), random)
    scene.poses = PoseTable(times, length=3.0)
    scene.poses.twists.data = 0.01 * torch.randn(len(times), 6, generator=random)
    return scene


def at_rest() -> GaussianScene:
    """The wall without the square's motion: no control points at all."""
    return new_scene(truth.observations(TRAIN), moving=False)
