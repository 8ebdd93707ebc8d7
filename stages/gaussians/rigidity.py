"""ARAP in the loss of stage 2. It needs no render: it is found beside the loss of the render and its gradient."""

import torch
from torch import Tensor

from stages.deformation.motion_models import Deformation
from stages.shared.torch_threads import one_torch_thread

Gradients = list[tuple[Tensor, Tensor]]
"""Parameters and their gradients."""


@one_torch_thread()
def rigidity(motion: Deformation | None, weight: float, times: Tensor) -> tuple[Tensor, Gradients]:
    """`weight` times the ARAP loss at `times` [B], without history, and its gradients.

    Parameters that it does not depend on are left out; without motion or weight it is zero.
    """
    if motion is None or weight <= 0:
        return times.new_zeros(()), []
    term, parameters = weight * motion.arap_loss(times), list(motion.parameters())
    gradients = torch.autograd.grad(term, parameters, allow_unused=True)
    return term.detach(), [(p, g) for p, g in zip(parameters, gradients, strict=True) if g is not None]


def add_gradients(gradients: Gradients) -> None:
    """Add to the gradients that the parameters have."""
    for parameter, gradient in gradients:
        parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
