"""How a step of training grows with pixels and Gaussians: on the CPU and, where one can be used, on a GPU, in turn.

The scenes are those of bench_training: the larger the frames, the wider is the view; splats have a footprint of 2 px.
"""

from collections import defaultdict

import numpy as np
import torch

from benchmarks.bench_training import measured_steps, random_trainer
from stages.splatting.rasterize import backend_name, choose_device

SIZES = ((512, 218, 50_000), (1024, 436, 300_000), (1920, 816, 1_000_000))
"""Width and height in px, and number of Gaussians."""


def main() -> None:
    """Print the median milliseconds of a step for every size on every device."""
    devices = dict.fromkeys((torch.device("cpu"), choose_device("auto")))
    for width, height, n in SIZES:
        for device in devices:
            trainer = random_trainer(n, width, height, str(device))
            wall_ms, cpu_ms = measured_steps(trainer, defaultdict(lambda: np.zeros(2)))["step"]
            where = torch.cuda.get_device_name() if device.type == "cuda" else f"{torch.get_num_threads()} threads"
            size = f"{width}x{height}, {n} Gaussians, {backend_name(device)}, {where}"
            print(f"{size}: {wall_ms:.1f} ms, {cpu_ms:.1f} CPU ms", flush=True)


if __name__ == "__main__":
    main()
