"""The network from the table: from the tracks alone it learns too slowly, so it starts from what the table knows."""

import torch
from torch.nn.functional import mse_loss

from stages.deformation.model import MLPDeformation, TableDeformation
from stages.shared.log import progress

STEPS = 1000
RATE = 2e-3
TIMES_PER_STEP = 4


def distil(table: TableDeformation, network: MLPDeformation, seed: int) -> None:
    """Teach `network`, in place, the motion of `table` at random moments, between the training frames too.

    Both have the same control points. The loss weighs rotations and translations alike, the latter in extents.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam([*network.hidden.parameters(), *network.head.parameters()], RATE, fused=True)
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
