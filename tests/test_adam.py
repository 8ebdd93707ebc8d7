"""Adam without torch's compiler makes torch's steps, and does not import the compiler."""

import subprocess
import sys

import pytest
import torch

from stages.shared.adam import Adam


def trained(kind: type[torch.optim.Adam]) -> list[torch.Tensor]:
    """Two parameters of groups with rates of their own after steps, one of which meets a group without gradient."""
    generator = torch.Generator().manual_seed(0)
    p, q = (torch.nn.Parameter(torch.randn(n, generator=generator)) for n in (50, 21))
    optimiser = kind([{"params": [p], "lr": 0.1}, {"params": [q], "lr": 0.01}], fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.9)
    for k in range(10):
        optimiser.zero_grad()
        ((p**2).sum() if k == 4 else (p**2).sum() + (q**4).sum() * p.sum()).backward()
        optimiser.step()
        schedule.step()
    return [p.detach(), q.detach(), *(optimiser.state[p][name] for name in ("exp_avg", "exp_avg_sq", "step"))]


@pytest.mark.parametrize("threads", ["1", "2"])
def test_steps_are_those_of_torch_bit_for_bit(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A single thread takes all groups at once."""
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    for own, torchs in zip(trained(Adam), trained(torch.optim.Adam), strict=True):
        assert torch.equal(own, torchs)


def test_a_step_does_not_import_the_compiler() -> None:
    code = "import sys, test_adam as t; t.trained(t.Adam); assert 'torch._dynamo' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=__file__.rpartition("/")[0])
