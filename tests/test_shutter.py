"""Pictures taken with an open shutter: their moments, the average in linear light, and its gradient."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import TRAIN, new_scene

from stages.gaussians.training_frames import with_smear
from stages.shared import lie
from stages.shared.cameras import project
from stages.simulate.frames import to_srgb
from stages.splatting import shutter
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.shutter import Moments, Shutter

SIZE = (truth.WIDTH, truth.HEIGHT)


def open_for(frames: float) -> Shutter:
    return Shutter(frames, truth.cameras(), np.tile(truth.K, (truth.T, 1, 1)))


def test_cameras_move_along_a_screw_between_frames_and_beyond_them() -> None:
    """Frames of one screw: all moments lie on it, those before the first and after the last frame too."""
    twist = np.array([0.1, -0.05, 0.2, 0.02, 0.3, -0.1])
    poses = lie.exp_se3(np.arange(6)[:, None] * twist)
    Ks = truth.K + np.arange(6)[:, None, None] * np.diag([2.0, 2.0, 0.0])  # of a lens that zooms
    for frame in (0, 2, 5):
        found = shutter.moments(Shutter(0.8, poses, Ks), frame, 4)
        positions = frame + np.array([-0.3, -0.1, 0.1, 0.3])
        np.testing.assert_allclose(found.times, positions / 5)
        np.testing.assert_allclose(found.cam_from_world, lie.exp_se3(positions[:, None] * twist), atol=1e-12)
        np.testing.assert_allclose(found.Ks[:, 0, 0], truth.K[0, 0] + 2 * positions)


def test_the_curve_is_that_of_srgb() -> None:
    radiance = torch.linspace(0, 1, 400, dtype=torch.float64)
    shown = shutter.to_display(radiance)
    assert np.abs(to_srgb(radiance.numpy()) - 255 * shown.numpy()).max() <= 0.5 + 1e-9  # rounded to 8 bits
    wide = torch.linspace(-0.2, 1.3, 50, dtype=torch.float64)
    torch.testing.assert_close(shutter.to_linear(shutter.to_display(wide)), wide)


@torch.no_grad()
def test_a_picture_is_the_mean_radiance_of_its_moments() -> None:
    scene = new_scene(truth.observations(TRAIN))
    picture = shutter.moments(open_for(0.9), 5, 4)
    views = [
        scene.render(float(time), torch.tensor(pose), torch.tensor(K), *SIZE).colour[0].double().numpy()
        for time, pose, K in zip(*picture, strict=True)
    ]
    linear = np.mean([np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4) for v in views], axis=0)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    found, renderings = shutter.expose(scene, picture, *SIZE)
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-5)
    assert len(renderings) == 4


def test_a_picture_at_one_moment_is_the_plain_render() -> None:
    scene = new_scene(truth.observations(TRAIN))
    found, _ = shutter.expose(scene, shutter.instant(truth.TIMES[3], truth.cameras()[3], truth.K), *SIZE)
    plain = scene.render(truth.TIMES[3], torch.tensor(truth.cameras()[3]), torch.tensor(truth.K), *SIZE).colour[0]
    assert torch.equal(found, plain)


def test_the_gradient_of_the_average_is_a_finite_difference() -> None:
    """From black, through the knee of the curve, to colours beyond white."""
    rng = torch.manual_seed(0)
    colours = [1.4 * torch.rand(5, 4, 3, dtype=torch.float64, generator=rng) - 0.1 for _ in range(3)]
    assert torch.autograd.gradcheck(lambda *c: shutter._Average.apply(False, *c), [c.requires_grad_() for c in colours])


@pytest.mark.parametrize("only_one", [False, True])
@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5, 3), (40, 96, 3)])
def test_the_kernels_average_as_torch_does_in_double_precision(
    shape: tuple[int, int, int], only_one: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From below black, through the knee of the curve, to colours far beyond white; whole vectors of pixels or not."""
    in_torch = shutter.to_display
    monkeypatch.setattr(shutter, "to_display", lambda x: in_torch(x) if x.dtype == torch.float64 else None)
    rng = torch.manual_seed(0)
    ends = torch.tensor([-0.1, 0.0, 0.04044, 0.04046, 1.0, 700.0])
    wide = [10 ** (2.9 * torch.rand(shape, generator=rng) - 2) - 0.1 for _ in range(3)]
    for colour, where in zip(wide, (0, 1, 2), strict=True):
        colour.view(-1)[: len(ends)] = ends[: colour.numel()].roll(where)
    expected = [colour.double().requires_grad_() for colour in wide]
    found = [colour.requires_grad_() for colour in wide]
    pictures = [shutter._Average.apply(only_one, *colours) for colours in (found, expected)]
    torch.testing.assert_close(pictures[0].double(), pictures[1], rtol=2e-6, atol=2e-7)
    weights = torch.rand(shape, generator=rng)
    for picture in pictures:
        (picture * weights.to(picture)).sum().backward()
    for single, double in zip(found, expected, strict=True):
        assert single.grad is not None
        torch.testing.assert_close(single.grad.double(), double.grad, rtol=5e-6, atol=1e-7)


def gradients(scene: GaussianScene, picture: Moments, followed: int | None) -> dict[str, torch.Tensor]:
    """Of a loss that is not linear in the picture, by parameter."""
    scene.zero_grad()
    image, _ = shutter.expose(scene, picture, *SIZE, followed=followed)
    (image**3).mean().backward()
    assert scene.deformation is not None
    values = dict(scene.gaussians.items()) | {"motion": scene.deformation.table}
    return {name: value.grad.clone() for name, value in values.items() if value.grad is not None}


def test_one_moment_at_random_has_the_gradient_of_all_on_average() -> None:
    scene, picture = new_scene(truth.observations(TRAIN)), shutter.moments(open_for(0.9), 5, 3)
    whole, parts = gradients(scene, picture, None), [gradients(scene, picture, s) for s in range(3)]
    assert whole["motion"].abs().max() > 0
    for name, value in whole.items():
        mean = torch.stack([part[name] for part in parts]).mean(dim=0)
        torch.testing.assert_close(mean, value, rtol=1e-3, atol=1e-4 * float(value.abs().max()) + 1e-9)
    assert (parts[0]["motion"] - whole["motion"]).abs().max() > 0.1 * whole["motion"].abs().max()


def test_the_gradient_by_the_motion_is_a_finite_difference() -> None:
    """A shift of the square at all times; the rasteriser drops what is nearly transparent, which is a small step.

    The square shifts downwards. To the right the loss changes by an eighth as much, and such steps are a tenth of that.
    """
    scene, picture = new_scene(truth.observations(TRAIN)), shutter.moments(open_for(0.9), 5, 3)
    assert scene.deformation is not None
    table, step = scene.deformation.table, 2e-3
    slope = float(gradients(scene, picture, None)["motion"][..., 5].sum())

    @torch.no_grad()
    def loss(shift: float) -> float:
        table[..., 5] += shift
        value = float((shutter.expose(scene, picture, *SIZE)[0].double() ** 3).mean())
        table[..., 5] -= shift
        return value

    assert slope == pytest.approx((loss(step) - loss(-step)) / (2 * step), rel=0.1)


def test_moments_are_as_many_as_the_smear_is_long() -> None:
    """The square moves by 3 px a frame; what rests is rendered once, as without a shutter."""
    seen = truth.observations(TRAIN)
    scene = new_scene(seen)
    counts = [len(shutter.open_moments(scene, open_for(s), 5, SIZE).times) for s in (0.1, 0.9)]
    assert counts == [1, 2]
    ends = shutter.moments(open_for(1.0), 5, 2)
    centres = [truth.square_centre(time)[None] for time in ends.times]
    before, after = (project(c, p, truth.K)[0] for c, p in zip(centres, ends.cam_from_world, strict=True))
    assert shutter.smear_px(scene, ends, SIZE) == pytest.approx(np.linalg.norm(after - before), rel=0.1)
    wall = new_scene(replace(seen, masks=np.zeros_like(seen.masks)), moving=False)
    at_rest = Shutter(1.0, np.tile(np.eye(4), (truth.T, 1, 1)), open_for(1.0).Ks)
    still = with_smear(seen, wall, at_rest)
    assert [len(still.picture(f).times) for f in range(len(TRAIN))] == [1] * len(TRAIN)
