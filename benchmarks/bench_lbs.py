"""Forward and backward pass of skinning: the fused numba kernel against gather and einsum in torch.

Run as `python -m benchmarks.bench_lbs`. Times are medians of alternated runs in one process, after a warm-up. Both
implementations compute the weights and all gradients from the same tensors.
"""

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.timing import alternated
from stages.deformation import lbs
from stages.shared import quaternions

CASES = ((20_000, 512, 4), (100_000, 512, 4), (20_000, 512, 8))
KERNEL, PLAIN = (lbs.lbs_weights, lbs.blend), (lbs.lbs_weights_torch, lbs.blend_torch)
ROUNDS = 15
GATE = 8.0
BYTES_PER_GAUSSIAN = 4 * (3 + 4) * 2 + 4 * (3 + 4)
"""Results and gradients of positions and quaternions, and the saved inputs, without index and weights."""


def skinning(N: int, P: int, K: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Tensors by name, squared distances and indices of neighbours [N, K] of random Gaussians in a unit cube."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(P, 3, generator=generator)
    leaves = {
        "means": torch.rand(N, 3, generator=generator),
        "quats": torch.randn(N, 4, generator=generator),
        "point_quats": quaternions.normalise(torch.randn(P, 4, generator=generator)),
        "point_translations": 0.1 * torch.randn(P, 3, generator=generator),
        "log_radii": torch.full((P,), -2.5),
    }
    index, sq_dist = lbs.neighbours(points, leaves["means"], K)
    return {"points": points} | {name: leaf.requires_grad_() for name, leaf in leaves.items()}, sq_dist, index


def step(
    functions: tuple[Callable, Callable],
    tensors: dict[str, Tensor],
    sq_dist: Tensor,
    index: Tensor,
    cotangents: tuple[Tensor, Tensor],
) -> None:
    """One forward and backward pass."""
    weigh, blend = functions
    weights = weigh(sq_dist, tensors["log_radii"], index)
    names = ("means", "quats", "points", "point_quats", "point_translations")
    results = blend(*(tensors[name] for name in names), weights, index)
    torch.autograd.grad(results, [tensor for tensor in tensors.values() if tensor.requires_grad], cotangents)


def main() -> None:
    """Print a line per case; fail if the kernel is less than GATE times as fast as torch."""
    failed = []
    for N, P, K in CASES:
        tensors, sq_dist, index = skinning(N, P, K)
        cotangents = torch.ones(N, 3), torch.ones(N, 4)
        works: dict[str, Callable[[], object]] = {
            name: functools.partial(step, functions, tensors, sq_dist, index, cotangents)
            for name, functions in (("kernel", KERNEL), ("torch", PLAIN))
        }
        kernel, plain = alternated(works, ROUNDS).values()
        print(
            f"N={N} P={P} K={K}: kernel {1e3 * kernel:.1f} ms, gather and einsum {1e3 * plain:.1f} ms,"
            f" ratio {plain / kernel:.1f} (at least {GATE:.0f}); {BYTES_PER_GAUSSIAN + 16 * K} bytes per Gaussian"
        )
        if plain < GATE * kernel:
            failed.append(N)
    if failed:
        raise SystemExit(f"skinning: less than {GATE:.0f} times as fast at N = {failed}")


if __name__ == "__main__":
    main()
