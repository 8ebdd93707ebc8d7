"""The Gaussians at a moment: the kernel against torch's operations, with all its gradients."""

import numpy as np
import pytest
import torch
from gaussian_scene import true_motion
from test_gaussians import small_cloud

from stages.splatting.colours import ColourTable
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.life_spans import presence
from stages.splatting.placed import TRAINED, Placed, drawn
from stages.splatting.raster_bins import MIN_ALPHA


def scene(lives: bool, coloured: bool, moving: bool = True) -> GaussianScene:
    cloud, generator = small_cloud(), torch.manual_seed(1)
    cloud.drifts = 0.1 * torch.randn(200, 3, generator=generator)
    if lives:
        cloud.births[150:] = torch.rand(50, generator=generator)
        cloud.log_spans[150:] = torch.randn(50, generator=generator) - 2
    if not moving:
        cloud.dynamic[:] = False
    motion = true_motion() if moving else None
    if motion is not None:
        motion.table.data += 0.1 * torch.randn(motion.table.shape, generator=generator)
    colours = ColourTable(torch.linspace(0, 1, 4), 16) if coloured else None
    if colours is not None:
        colours.table.data = torch.randn(colours.table.shape, generator=generator)
    return GaussianScene(cloud, motion, torch.zeros(3), 0.02, 4, colours)


def gradients(scene: GaussianScene, placed: Placed) -> dict[str, torch.Tensor | None]:
    """Of one fixed number, by all that is trained."""
    scene.zero_grad()
    generator = torch.manual_seed(2)
    sum((values * torch.randn(values.shape, generator=generator)).sum() for values in placed).backward()  # type: ignore[union-attr]
    return {name: parameter.grad for name, parameter in scene.named_parameters()}


@pytest.mark.parametrize("detach", [False, True])
@pytest.mark.parametrize(("lives", "coloured"), [(True, True), (True, False), (False, True)])
def test_values_and_gradients_equal_those_of_torch(lives: bool, coloured: bool, detach: bool) -> None:
    own = scene(lives, coloured)
    rows = own.rows_at(0.3)
    assert (rows is None) == (not lives)
    assert rows is None or 150 < len(rows) < 190
    found, expected = own.placed(0.3, detach, rows), own.placed_torch(0.3, detach, rows)
    for name, one, other in zip(Placed._fields, found, expected, strict=True):
        assert torch.allclose(one, other, rtol=1e-5, atol=1e-6), name
    by_kernel, by_torch = gradients(own, found), gradients(own, expected)
    for name, expected_gradient in by_torch.items():
        gradient = by_kernel[name]
        assert (gradient is None) == (expected_gradient is None), name
        if gradient is not None and expected_gradient is not None:
            largest = float(expected_gradient.abs().max())
            assert torch.allclose(gradient, expected_gradient, rtol=1e-4, atol=1e-5 * largest), name
    assert (by_kernel["deformation.table"] is None) == detach
    assert (by_kernel["gaussians.drifts"] is None) == (not lives)


@pytest.mark.parametrize("n_static", [0, 150])
def test_gaussians_that_are_not_there_have_no_gradient(n_static: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the memory held before: also those before the first and after the last that is there, and all."""
    own = scene(lives=True, coloured=False)
    cloud = own.cloud()
    cloud.dynamic[n_static:] = True
    cloud.log_spans[:] = -2
    own.set_cloud(cloud)
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, 7, dtype))
    kept = torch.arange(n_static)
    for rows in (torch.cat([kept, torch.tensor([160, 161, 170])]), kept):
        found = gradients(own, own.placed(0.3, rows=rows))
        away = torch.ones(200, dtype=torch.bool)
        away[rows] = False
        for name in TRAINED:
            gradient = found[f"gaussians.{name}"]
            assert gradient is not None
            assert (gradient[away] == 0).all(), name
        for name in ("log_spans", "drifts"):
            assert (found[f"gaussians.{name}"][:n_static] == 0).all(), name  # type: ignore[index]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_what_is_drawn_is_what_torch_finds_opaque_enough(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    generator = torch.manual_seed(5)
    births, logits = torch.rand(501, generator=generator), 3 * torch.randn(501, generator=generator)
    log_spans = torch.randn(501, generator=generator) - 2
    opacities = logits.sigmoid() * presence(births, log_spans, 0.4)
    rows = drawn(births, logits, log_spans, 0.4)
    assert 100 < len(rows) < 400
    assert torch.equal(rows, torch.nonzero(opacities > MIN_ALPHA)[:, 0])


def test_a_static_scene_is_where_its_parameters_say() -> None:
    own = scene(lives=False, coloured=False, moving=False)
    found = own.placed(0.3)
    assert torch.equal(found.means, own.anchors)
    by_kernel, by_torch = gradients(own, found), gradients(own, own.placed_torch(0.3))
    for name in {f"gaussians.{name}" for name in TRAINED} - {"gaussians.log_spans", "gaussians.drifts"}:
        found_gradient, expected = by_kernel[name], by_torch[name]
        assert found_gradient is not None
        assert expected is not None
        assert torch.allclose(found_gradient, expected, rtol=1e-5, atol=1e-6), name
