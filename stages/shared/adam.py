"""Adam without torch's compiler. This is not part of modules that stages without torch import."""

import inspect

import torch

from stages.shared.threads import spread


class Adam(torch.optim.Adam):
    """`torch.optim.Adam` with `fused=True`, with the same steps bit for bit.

    The methods of torch's own import its compiler when they are first called, to keep themselves out of it: 1.3 CPU
    seconds, although nothing here is compiled. The first two are the same functions without that wrapper. A step takes
    the groups of parameters on all threads of the job, and leaves out what torch does for other settings.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)

    def step(self) -> None:  # type: ignore[override]
        """Step by the gradients at hand; parameters without one stay."""
        spread(self._step_groups, len(self.param_groups), torch.get_num_threads())

    @torch.no_grad()
    def _step_groups(self, first: int, last: int, threads: int) -> None:
        """Step the groups `first` to `last` with as many of torch's own threads as the caller has."""
        torch.set_num_threads(threads)
        for group in self.param_groups[first:last]:
            tensors: list[list[torch.Tensor]] = [[], [], [], [], [], []]
            self._init_group(group, *tensors)  # type: ignore[no-untyped-call]
            if not tensors[0]:
                continue
            torch._foreach_add_(tensors[-1], 1)
            beta1, beta2 = group["betas"]
            shared = {name: group[name] for name in ("lr", "weight_decay", "eps", "amsgrad", "maximize")}
            torch._fused_adam_(*tensors, **shared, beta1=beta1, beta2=beta2)
