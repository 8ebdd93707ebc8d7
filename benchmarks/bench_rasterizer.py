"""Rasteriser and SSIM against plain torch, and the rasteriser against the arithmetic limit of this machine.

Run as `python -m benchmarks.bench_rasterizer`. Times are medians of alternated runs in one process, after a warm-up.
Both implementations start from the same projected splats and include sorting and binning. The comparison with the limit
is in CPU time.
"""

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from benchmarks import torch_rasterizer
from benchmarks.timing import alternated
from stages.gaussians.ssim import Target, photometric_loss, ssim_torch
from stages.shared.lanes import LANES, load, store
from stages.splatting import raster_adjoint, raster_bins, raster_kernels
from stages.splatting.drawing_order import drawing_order

FLOP_PER_PAIR = 93
"""Per contributing pair of pixel and Gaussian, 31 forward and 62 backward, counted by hand in the inner loops."""
CASES = ((20_000, 512, 218, 5), (100_000, 1024, 436, 3))
CHAINS = 12
"""Number of independent vectors in the loop that measures the peak."""
GATES = {"rasteriser": 60.0, "SSIM": 5.0, "limit": 20.0}


def random_splats(N: int, width: int, height: int) -> dict[str, Tensor]:
    """N random splats as in `raster_bins`, arrays [N, ...] by name.

    Sizes are log-normal around 0.9 sqrt(pixels / N), directions uniform, opacities logit-normal.
    """
    random = np.random.default_rng(0)
    sigma = 0.9 * np.sqrt(width * height / N) * np.exp(0.4 * random.normal(size=(N, 2)))
    angle = random.uniform(0, np.pi, N)
    axes = np.stack([np.stack([np.cos(angle), -np.sin(angle)], -1), np.stack([np.sin(angle), np.cos(angle)], -1)], 1)
    cov = axes @ (sigma[:, :, None] ** 2 * axes.swapaxes(1, 2)) + 0.3 * np.eye(2)
    det = np.linalg.det(cov)
    f0 = np.sqrt(cov[:, 1, 1] / (2 * det))
    values = {
        "centres": random.uniform(-0.02, 1.02, (N, 2)) * [width, height],
        "factors": np.stack([f0, -cov[:, 0, 1] / cov[:, 1, 1] * f0, 1 / np.sqrt(2 * cov[:, 1, 1])], axis=-1),
        "opacities": 1 / (1 + np.exp(-random.normal(0.5, 1.5, N))),
        "colours": random.uniform(size=(N, 3)),
        "depths": random.uniform(1, 10, N),
    }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}


def kernels(splats: dict[str, Tensor], gradients: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Gradients of the splats by the numba kernels, from those of colour, depth and alpha, including all steps."""
    height, width = gradients[1].shape
    arrays = [splats[name].numpy() for name in ("centres", "factors", "opacities", "colours", "depths")]
    order = drawing_order(arrays[-1])
    rows = raster_bins.gather(order, height, *arrays)
    starts, entries, slots = raster_bins.bin_tiles(rows, width, height)
    images = raster_kernels.composite(rows, starts, entries, np.zeros(3, np.float32), height, width)
    sums = raster_adjoint.composite_adjoint(rows, starts, entries, *images, *gradients)
    return raster_adjoint.splat_gradients(order, rows, slots, sums, len(arrays[-1]))


@njit(cache=True)
def contributing_pairs(splats: np.ndarray, starts: np.ndarray, ranks: np.ndarray, width: int, height: int) -> int:
    """Number of (pixel, Gaussian) pairs above both thresholds: the work that no implementation can avoid."""
    columns = (width + raster_bins.TILE - 1) // raster_bins.TILE
    pairs = 0
    for v in range(height):
        for u in range(width):
            tile = v // raster_bins.TILE * columns + u // raster_bins.TILE
            T = 1.0
            for k in range(starts[tile], starts[tile + 1]):
                splat = splats[ranks[k]]
                dx, dy = splat[0] - u, splat[1] - v
                q, r = splat[2] * dx + splat[3] * dy, splat[4] * dy
                alpha = min(0.999, splat[5] * np.exp(-q * q - r * r))
                if alpha >= 1 / 255 and T > 1e-4:
                    pairs += 1
                    T *= 1 - alpha
    return pairs


@njit(parallel=True, cache=True)
def fused_multiply_adds(x: np.ndarray, turns: int) -> None:
    """Perform `turns` multiply-adds on CHAINS vectors in registers, for each row of x [rows, CHAINS + 1, LANES]."""
    for row in prange(len(x)):
        start = (CHAINS + 1) * LANES * row
        gain = load(x, start + CHAINS * LANES)
        a, b, c, d = load(x, start), load(x, start + 16), load(x, start + 32), load(x, start + 48)
        e, f, g, h = load(x, start + 64), load(x, start + 80), load(x, start + 96), load(x, start + 112)
        i, j, k, m = load(x, start + 128), load(x, start + 144), load(x, start + 160), load(x, start + 176)
        for _ in range(turns):
            a, b, c, d = a * gain + gain, b * gain + gain, c * gain + gain, d * gain + gain
            e, f, g, h = e * gain + gain, f * gain + gain, g * gain + gain, h * gain + gain
            i, j, k, m = i * gain + gain, j * gain + gain, k * gain + gain, m * gain + gain
        store(x, start, a + b + c + d + e + f + g + h + i + j + k + m)


def peak_flops() -> float:
    """Peak rate of float32 multiply-adds of one core, in flop per second of CPU time; the best of several runs.

    The loop consists of CHAINS independent multiply-adds of whole vectors, more than latency x number of units of any
    present CPU. Measured in CPU time, this is the peak of the core even while other jobs share it.
    """
    x, turns = np.random.default_rng(0).uniform(0.4, 0.6, (64, CHAINS + 1, LANES)).astype(np.float32), 20_000
    fused_multiply_adds(x, 10)
    seconds = cpu_seconds(lambda: fused_multiply_adds(x, turns), 10)
    return 2 * turns * len(x) * CHAINS * LANES / seconds


def cpu_seconds(work: Callable[[], object], rounds: int) -> float:
    """Smallest CPU time, summed over all threads, of several calls."""
    least = math.inf
    for _ in range(rounds):
        began = time.process_time()
        work()
        least = min(least, time.process_time() - began)
    return least


def bench_rasterizer(N: int, width: int, height: int, rounds: int, flops: float) -> None:
    """Print seconds and the ratios to torch and to the limit for one size."""
    splats = random_splats(N, width, height)
    random = np.random.default_rng(1)
    shapes = (height, width, 3), (height, width), (height, width)
    gradients = tuple(random.normal(size=shape).astype(np.float32) for shape in shapes)
    tiles = -(-width // 16) * -(-height // 16)
    weights = torch.tensor(random.normal(size=(tiles, 256, 5)), dtype=torch.float32)
    arrays = [splats[name].numpy() for name in ("centres", "factors", "opacities", "colours", "depths")]
    rows = raster_bins.gather(drawing_order(arrays[-1]), height, *arrays)
    bins = raster_bins.bin_tiles(rows, width, height)
    pairs = contributing_pairs(rows, bins.starts, bins.entries[:, raster_bins.RANK].copy(), width, height)
    works = {
        "numba": lambda: kernels(splats, gradients),
        "torch": lambda: torch_rasterizer.forward_and_backward(splats, weights, width, height),
    }
    seconds = alternated(works, rounds)
    ratio = seconds["torch"] / seconds["numba"]
    cpu_s, limit_s = cpu_seconds(works["numba"], 5 * rounds), pairs * FLOP_PER_PAIR / flops
    milliseconds = {name: 1e3 * value for name, value in seconds.items()}
    print(
        f"  {N} Gaussians, {width}x{height}: numba {milliseconds['numba']:.1f} ms, torch {milliseconds['torch']:.0f} ms"
    )
    print(f"    {ratio:.0f}x torch (goal {GATES['rasteriser']:.0f}x)")
    print(f"    {pairs / 1e6:.2f} M pairs x {FLOP_PER_PAIR} flop take one core at least {1e3 * limit_s:.2f} ms")
    print(f"    {1e3 * cpu_s:.1f} CPU ms: {cpu_s / limit_s:.0f}x that (goal {GATES['limit']:.0f}x)")


def bench_ssim(width: int, height: int) -> None:
    """Print the seconds of SSIM with its gradient, by the fused kernels and by convolutions."""
    generator = torch.manual_seed(0)
    image = torch.rand(height, width, 3, generator=generator).requires_grad_()
    target = Target(torch.rand(height, width, 3, generator=generator))
    works = {
        "fused": lambda: torch.autograd.grad(photometric_loss(image, target, 1.0)[0], image),
        "torch": lambda: torch.autograd.grad(ssim_torch(image, target), image),
    }
    seconds = alternated(works, 15)
    ratio = seconds["torch"] / seconds["fused"]
    print(
        f"  SSIM {width}x{height}: fused {1e3 * seconds['fused']:.1f} ms, torch {1e3 * seconds['torch']:.1f} ms:"
        f" {ratio:.1f}x (goal {GATES['SSIM']:.0f}x)"
    )


def main() -> None:
    """Print one line per case."""
    flops = peak_flops()
    print(f"rasteriser, forward and backward, {torch.get_num_threads()} threads; a core does {flops / 1e9:.0f} GFLOP/s")
    for N, width, height, rounds in CASES:
        bench_rasterizer(N, width, height, rounds, flops)
    for width, height in ((512, 218), (1024, 436)):
        bench_ssim(width, height)


if __name__ == "__main__":
    main()
