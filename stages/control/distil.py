"""Distillation of the table into the network, which learns too slowly from the tracks alone."""

import torch
from torch.nn.functional import mse_loss

from stages.deformation.motion_models import MLPDeformation, TableDeformation
from stages.shared.adam import Adam
from stages.shared.log import progress

STEPS = 1000
RATE = 2e-3
TIMES_PER_STEP = 4


def distil(table: TableDeformation, network: MLPDeformation, seed: int) -> None:
    """Fit `network`, in place, to the motion of `table` at random times, also between the training frames.

    Both have the same control points. Rotations and translations weigh the same in the loss; translations are in units
    of the extent.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser = Adam([*network.hidden.parameters(), *network.head.parameters()], RATE, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.02 ** (1 / STEPS))
    for _ in progress(range(STEPS), "distil"):
        times = torch.rand(TIMES_PER_STEP, generator=generator)
        with torch.no_grad():
            motion = table.raw_motion(times)
        loss = mse_loss(network.raw_motion(times), motion)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
