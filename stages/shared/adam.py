"""Adam without torch's compiler. This is not part of modules that stages without torch import."""

import inspect

import torch


class Adam(torch.optim.Adam):
    """`torch.optim.Adam`, with the same steps bit for bit.

    The methods of torch's own import its compiler when they are first called, to keep themselves out of it: 1.3 CPU
    seconds, although nothing here is compiled. These are the same functions without that wrapper.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
