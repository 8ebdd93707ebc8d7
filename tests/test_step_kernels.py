"""The kernels of a training step outside the rasteriser, and what runs beside it, against torch's operations."""

import gaussian_scene as truth
import pytest
import torch
from gaussian_scene import true_motion
from gaussian_training import TRAIN, new_scene

from stages.gaussians import optimise
from stages.gaussians.densify import GradientRecord
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.rigidity import add_gradients, rigidity
from stages.splatting.gains import lit


@pytest.mark.parametrize("rows", [None, torch.tensor([0, 1, 4, 7])])
def test_a_record_adds_the_lengths_of_gradients(rows: torch.Tensor | None) -> None:
    record, generator = GradientRecord(torch.arange(8.0), torch.ones(8)), torch.manual_seed(0)
    gradient = torch.randn(1, 8 if rows is None else 4, 2, generator=generator)
    gradient[0, 2] = 0
    where = torch.arange(8) if rows is None else rows
    total = torch.arange(8.0).index_add(0, where, gradient[0].norm(dim=-1))
    views = torch.ones(8).index_add(0, where, (gradient[0] != 0).any(dim=-1).float())
    record.add(gradient, rows)
    assert torch.allclose(record.total, total, rtol=1e-6)
    assert torch.equal(record.views, views)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_gains_and_their_gradients_equal_those_of_torch(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    generator = torch.manual_seed(0)
    colour, weights = (torch.randn(1, 13, 7, 3, generator=generator) for _ in range(2))
    gain, single = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([1.5])
    for factors in (gain, single.expand(3)):
        found = []
        for product in (lit, torch.mul):
            image, g = colour.clone().requires_grad_(), factors.clone().requires_grad_()
            result = product(image, g)
            (result * weights).sum().backward()
            found.append((result, image.grad, g.grad))
        (own, by_image, by_gain), (expected, image_gradient, gain_gradient) = found
        assert torch.equal(own, expected)
        assert torch.equal(by_image, image_gradient)
        assert torch.allclose(by_gain, gain_gradient, rtol=1e-5)


def test_rigidity_and_its_gradient_are_those_of_one_backward_pass() -> None:
    motion, times = true_motion(), torch.tensor([0.2, 0.7])
    motion.table.data += 0.1 * torch.randn(motion.table.shape, generator=torch.manual_seed(1))
    render = (motion.table**2).sum()
    (render + 0.3 * motion.arap_loss(times)).backward()  # type: ignore[no-untyped-call]
    expected = motion.table.grad
    motion.zero_grad()
    term, gradients = rigidity(motion, 0.3, times)
    (motion.table**2).sum().backward()  # type: ignore[no-untyped-call]
    add_gradients(gradients)
    assert torch.equal(term, 0.3 * motion.arap_loss(times))
    assert float(term) > 0
    assert not term.requires_grad
    assert motion.table.grad is not None
    assert expected is not None
    assert torch.equal(motion.table.grad, expected)
    assert motion.log_radii.grad is None
    motion.zero_grad()
    add_gradients(gradients)
    assert torch.equal(motion.table.grad, gradients[0][1])


def test_without_motion_or_weight_nothing_is_rigid() -> None:
    for motion, weight in ((None, 0.3), (true_motion(), 0.0)):
        term, gradients = rigidity(motion, weight, torch.tensor([0.5]))
        assert float(term) == 0
        assert gradients == []


@pytest.mark.parametrize("threads", ["1", "3"])
def test_a_step_adds_rigidity_to_its_loss_and_its_gradient(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam's first moments after a step are a share of the gradient."""
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    monkeypatch.setattr(optimise, "LEFT_OUT_SHARE", 0.0)
    seen, weight, found = truth.observations(TRAIN), 0.3, []
    for of in (0.0, weight):
        scene = new_scene(seen)
        assert scene.deformation is not None
        table = scene.deformation.get_parameter("table")
        table.data += 0.1 * torch.randn(table.shape, generator=torch.manual_seed(1))
        trainer = Trainer(scene, seen, GaussiansOptions(steps=1), of)
        own = weight * scene.deformation.arap_loss(trainer._arap_times(trainer._frame_of_step()))
        (gradient,) = torch.autograd.grad(own, table)
        trainer.run(lambda _: None)
        found.append((trainer.history.loss[0], trainer.optimiser.state[table]["exp_avg"]))
    (bare, by_render), (loss, moments) = found
    assert float(own.detach()) > 0.001
    assert loss - bare == pytest.approx(float(own.detach()), rel=1e-3)
    assert gradient.abs().max() > 1e-4
    wanted = (1 - optimise.BETAS[0]) * gradient
    assert torch.allclose(moments - by_render, wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))
