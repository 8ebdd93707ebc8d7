"""The network at the borders of masks: its kernel against torch, what it leaves alone, and what is shipped."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from stages.segment import network as shipped
from stages.segment.network import REACH, STEPS, WEIGHTS, Network, correct, read_network

MAPS, WIDTH, H, W = 5, 4, 40, 70


def drawn(seed: int = 0) -> Network:
    """A network with random weights."""
    rng = np.random.default_rng(seed)
    shapes = (WIDTH, MAPS), (WIDTH,), (len(STEPS), WIDTH, WIDTH, 3, 3), (len(STEPS), WIDTH), (WIDTH,), (1,)
    return Network(*(rng.normal(0, 0.4, shape).astype(np.float32) for shape in shapes))


def maps_and_sureness() -> tuple[np.ndarray, np.ndarray]:
    """Random maps [n, H, W], of which the first belongs to the sureness [H, W]."""
    maps = np.random.default_rng(1).normal(0, 1, (MAPS, H, W)).astype(np.float32)
    sureness = np.random.default_rng(2).random((H, W)).astype(np.float32)
    maps[0] = 2 * sureness - 1
    return maps, sureness


def by_torch(network: Network, maps: np.ndarray, sureness: np.ndarray) -> np.ndarray:
    """What it says of every pixel [H, W], by torch's convolutions."""
    first, first_bias, kernels, biases, last, last_bias = (torch.from_numpy(of) for of in network)
    found = functional.relu(functional.conv2d(torch.from_numpy(maps)[None], first[..., None, None], first_bias))
    for step, kernel, bias in zip(STEPS, kernels, biases, strict=True):
        found = found + functional.relu(functional.conv2d(found, kernel, bias, padding=step, dilation=step))
    added = functional.conv2d(found, last[None, :, None, None], last_bias)[0, 0]
    known = shipped.BELIEVED * torch.from_numpy(2 * sureness - 1)
    return torch.sigmoid(shipped.COUNTED * added + known).numpy()


def test_the_kernel_agrees_with_torch() -> None:
    maps, sureness = maps_and_sureness()
    found = correct(drawn(), maps, np.ones((H, W), bool), sureness)
    np.testing.assert_allclose(found, by_torch(drawn(), maps, sureness), atol=1e-5)
    assert found.std() > 0.1


def test_a_part_is_judged_as_in_the_whole_and_the_rest_is_left_alone() -> None:
    """What lies within its reach counts, also outside of what is asked; beyond it is not even read."""
    maps, sureness = maps_and_sureness()
    asked = np.zeros((H, W), bool)
    asked[15:20, 30:33] = True
    whole = by_torch(drawn(), maps, sureness)
    maps[:, :, 33 + REACH + 1 :] = np.nan
    found = correct(drawn(), maps, asked, sureness)
    np.testing.assert_allclose(found[asked], whole[asked], atol=1e-5)
    np.testing.assert_array_equal(found[~asked], sureness[~asked])
    assert np.abs(found - sureness)[asked].max() > 0.05
    np.testing.assert_array_equal(correct(drawn(), maps, np.zeros((H, W), bool), sureness), sureness)


def test_what_it_is_told_stays_as_it_was() -> None:
    maps, sureness = maps_and_sureness()
    before = maps.copy(), sureness.copy()
    correct(drawn(), maps, np.ones((H, W), bool), sureness)
    np.testing.assert_array_equal(maps, before[0])
    np.testing.assert_array_equal(sureness, before[1])


@pytest.mark.parametrize("far", [1e4, -1e4, 120.0, -120.0])
def test_certain_logits_do_not_overflow(far: float) -> None:
    """Their sigmoid ends at 0 or 1, without a warning (pyproject.toml makes it an error)."""
    network = drawn()._replace(last_bias=np.float32([far]))
    maps, sureness = maps_and_sureness()
    found = correct(network, 0 * maps, np.ones((H, W), bool), sureness)
    assert np.isfinite(found).all()
    assert (found > 0.99).all() if far > 0 else (found < 0.01).all()


def test_the_shipped_one_is_small_and_fits_what_the_stage_tells_it() -> None:
    network = read_network()
    assert WEIGHTS.stat().st_size < 1_000_000
    assert sum(of.size for of in network) == 5461, "as its card says"
    assert network.first.shape[1] == 17, "maps of `maps_of`"
    assert network.kernels.shape[:3] == (len(STEPS), len(network.first), len(network.first))
    assert len(network.last) == len(network.first)
