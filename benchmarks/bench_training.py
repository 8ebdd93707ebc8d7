"""Where the time of training goes, and what a Gaussian costs in memory.

`python -m benchmarks.bench_training` takes a random scene: 45,000 static and 5,000 dynamic Gaussians on 512 control
points, 512 x 218 pixels. Parts are medians over steps of the same run; "other" is what no part claims. ARAP has a
thread of its own, and counts in the parts that it runs beside. On a busy machine trust the CPU milliseconds (all
threads together), not the wall clock. Memory is the growth of the peak of the process from this to a larger scene.

`python -m benchmarks.bench_training results/<dataset>/<sequence> ...` trains sequences again, as they were trained
there, and prints the share of every part in the whole training; results/<dataset>/<sequence>/settings/<setting> is one
under a setting of a sweep. Nothing is written. Run it twice: the first run compiles. `--device cpu cuda` trains each of
them on the CPU, then on the GPU, whose step is not shared out: its parts are kernels that wait for each other there.
"""

import argparse
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from stages.deformation import lbs_kernels, weight_kernels
from stages.deformation.motion_models import TableDeformation
from stages.gaussians import ssim_kernels
from stages.gaussians.beginning import Beginning, begin
from stages.gaussians.optimise import Trainer, training_psnr
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.adam import Adam
from stages.shared.artifacts import read_metadata
from stages.shared.cameras import centred_intrinsics
from stages.splatting import (
    placed,
    projection_kernels,
    raster_adjoint,
    raster_bins,
    raster_kernels,
    shadow_kernels,
    shutter_kernels,
)
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.rasterize import backend_name

N, N_DYNAMIC, P, WIDTH, HEIGHT, F = 50_000, 5_000, 512, 512, 218, 4
STEPS, WARM_UP = 30, 3
N_LARGE = 200_000
GOAL_MS = 60.0
PARTS: dict[str, list[tuple[Any, str]]] = {
    "rasterise": [(raster_bins, "gather"), (raster_bins, "bin_tiles"), (raster_kernels, "composite")],
    "rasterise, backward": [(raster_adjoint, "composite_adjoint"), (raster_adjoint, "splat_gradients")],
    "project": [(projection_kernels, "project")],
    "project, backward": [(projection_kernels, "project_adjoint")],
    "place": [(placed, "spread")],
    "skin": [
        (module, name + suffix)
        for module, name in (
            (weight_kernels, "softmax_weights"),
            (lbs_kernels, "blend"),
            (weight_kernels, "blend_values"),
        )
        for suffix in ("", "_adjoint")
    ],
    "shade": [(shadow_kernels, "faded_weights")],
    "mean of moments": [(shutter_kernels, name) for name in ("average", "average_adjoint")],
    "loss with gradient": [(ssim_kernels, "compare")],
    "Adam": [(Adam, "step")],
}

INPUTS = {
    "sequence": "lens/sequence.json",
    "masks": "masks",
    "poses": "ba/poses.parquet",
    "depth": "ba/depth.arrow",
    "scene": "scene.json",
    "points": "control/points.parquet",
    "deformation": "control/deformation.safetensors",
}
"""Inputs of the stage, in the folder of a sequence."""


def random_trainer(n: int, width: int = WIDTH, height: int = HEIGHT, device: str = "cpu") -> Trainer:
    """A trainer with n random Gaussians, as dense as those of a lifted frame, and random images of width x height."""
    random = np.random.default_rng(0)
    depths = random.uniform(2, 8, n)
    focal_px = 450.0
    uv = random.uniform(-0.5, 0.5, (n, 2)) * [width, height]
    means = np.concatenate([uv / focal_px, np.ones((n, 1))], axis=1) * depths[:, None]
    footprints = torch.tensor(2 * depths / focal_px, dtype=torch.float32)
    cloud = Cloud(
        means=torch.tensor(means, dtype=torch.float32),
        footprints=footprints,
        log_scales=(0.7 * footprints).log()[:, None] + 0.3 * torch.randn(n, 3, generator=torch.manual_seed(0)),
        quats=torch.randn(n, 4, generator=torch.manual_seed(1)),
        logits=torch.randn(n, generator=torch.manual_seed(2)) + 0.5,
        sh=torch.randn(n, 1, 3, generator=torch.manual_seed(3)),
        dynamic=torch.arange(n) >= n - N_DYNAMIC * n // N,
    )
    points = cloud.means[-P:]
    motion = TableDeformation(points, torch.full((P,), -1.0), torch.linspace(0, 1, F))
    images = random.uniform(size=(F, height, width, 3)).astype(np.float32)
    empty = np.zeros((F, height, width))
    K = centred_intrinsics(focal_px, width, height)
    poses, Ks = np.tile(np.eye(4), (F, 1, 1)), np.tile(K, (F, 1, 1))
    seen = TrainingFrames(images, empty > 0, empty + 5, empty > 0, poses, Ks, np.linspace(0, 1, F))
    colours = ColourTable(torch.linspace(0, 1, F), P)
    scene = GaussianScene(cloud, motion, torch.zeros(3), 0.05, neighbours=4, colours=colours)
    return Trainer(scene.to(device), seen, GaussiansOptions(steps=1000, densify=False), arap_weight=0.01)


Times = defaultdict[str, np.ndarray]
"""Wall and CPU seconds [2] by part."""


def now() -> np.ndarray:
    """Wall and CPU seconds [2]."""
    return np.array([time.perf_counter(), time.process_time()])


def clocked(function: Callable[..., Any], seconds: Times, part: str) -> Callable[..., Any]:
    """The function, wrapped so that it adds its time to `seconds[part]`."""

    def wrapper(*arguments: Any, **options: Any) -> Any:
        began = now()
        try:
            return function(*arguments, **options)
        finally:
            seconds[part] = seconds[part] + now() - began

    return wrapper


def measured_steps(trainer: Trainer, seconds: Times) -> dict[str, np.ndarray]:
    """Median wall and CPU milliseconds [2] of each part and of the whole step."""
    rows: list[dict[str, np.ndarray]] = []
    for _ in range(WARM_UP + STEPS):
        seconds.clear()
        began = now()
        trainer._train_step()
        trainer.step += 1
        rows.append(dict(seconds) | {"step": now() - began})
    zero = np.zeros(2)
    medians = {
        part: 1e3 * np.median([row.get(part, zero) for row in rows[WARM_UP:]], axis=0) for part in (*PARTS, "step")
    }
    return medians | {"other": medians["step"] - np.sum([medians[part] for part in PARTS], axis=0)}


def peak_bytes() -> int:
    """Peak resident memory of this process, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def beginning_of(folder: Path, scratch: Path, device: str = "auto") -> Beginning:
    """The trainer at step 0 for the results in `folder`, under the options that they were trained with, on `device`.

    What a setting shares with the sequence that it belongs to lies there: SEQUENCE/settings/SETTING.
    """
    places = [folder, *list(folder.absolute().parents)[1:2]]
    found = {
        name: next((place / path for place in places if (place / path).exists()), None) for name, path in INPUTS.items()
    }
    model = folder / "gaussians/model.safetensors"
    missing = [INPUTS[name] for name, path in found.items() if path is None] + ([] if model.exists() else [str(model)])
    if missing:
        raise SystemExit(f"{folder}: no {missing[0]}: name a folder results/<dataset>/<sequence> that is trained")
    options = GaussiansOptions.model_validate(read_metadata(model)["options"] | {"device": device})
    return begin(**{name: path for name, path in found.items() if path}, options=options, scratch=scratch)


def profile(folder: Path, seconds: Times, device: str = "auto") -> str:
    """The seconds of one whole training on `device`, and on the CPU the share of every part."""
    with TemporaryDirectory() as scratch:
        began = now()
        start = beginning_of(folder, Path(scratch), device)
        begun = now()
        seconds.clear()
        start.trainer.run(lambda _: None)
        (ready_s, _), (wall_s, cpu_s) = begun - began, now() - begun
    on_gpu, peak_mb = start.trainer.device.type == "cuda", peak_bytes() / 1e6
    gpu = f", {torch.cuda.max_memory_allocated() / 1e6:.0f} MB on the GPU" if on_gpu else ""
    shares = {part: 100 * seconds[part][1] / cpu_s for part in PARTS}
    scene, threads = start.trainer.scene, torch.get_num_threads()
    moving = 100 * (1 - scene.n_static / len(scene.anchors))
    lines = [
        f"{folder}: {backend_name(start.trainer.device)}: {start.trainer.step} steps in {wall_s:.1f} s, "
        f"{cpu_s:.1f} CPU s, {threads} threads busy {100 * cpu_s / wall_s / threads:.0f} %, after {ready_s:.1f} s to "
        f"begin; {len(scene.anchors)} Gaussians, {moving:.0f} % of them dynamic; "
        f"{training_psnr(scene, start.seen):.2f} dB on training frames; peak memory so far {peak_mb:.0f} MB{gpu}"
    ]
    if on_gpu:
        return lines[0]
    lines += [f"  {part:22}{share:5.0f} % of CPU" for part, share in shares.items()]
    return "\n".join([*lines, f"  {'other':22}{100 - sum(shares.values()):5.0f} % of CPU"])


def main() -> None:
    """Print where the time goes in the training of the folders named, or of the random scene."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_training", description=main.__doc__)
    parser.add_argument("folder", nargs="*", type=Path, help="results/<dataset>/<sequence>, trained")
    parser.add_argument("--device", nargs="+", choices=["auto", "cpu", "cuda"], help="where to train folders, in turn")
    chosen = parser.parse_args()
    if chosen.device and not chosen.folder:
        parser.error("--device: for the training of folders; benchmarks.step_sizes takes random scenes on every device")
    seconds: Times = defaultdict(lambda: np.zeros(2))
    for part, functions in PARTS.items():
        for owner, name in functions:
            setattr(owner, name, clocked(getattr(owner, name), seconds, part))
    for folder in chosen.folder:
        for device in chosen.device or ["auto"]:
            print(profile(folder, seconds, device), flush=True)
    if not chosen.folder:
        random_scene(seconds)


def random_scene(seconds: Times) -> None:
    """Print the milliseconds of each part and the bytes per Gaussian."""
    trainer = random_trainer(N)
    medians = measured_steps(trainer, seconds)
    wall_ms, cpu_ms = medians["step"]
    size = f"{N} Gaussians, {WIDTH}x{HEIGHT}, {torch.get_num_threads()} threads"
    print(f"training step, {size}: {wall_ms:.1f} ms (goal {GOAL_MS:.0f}), {cpu_ms:.1f} CPU ms")
    for part in (*PARTS, "other"):
        wall, cpu = medians[part]
        print(f"  {part:22}{wall:7.1f} ms{cpu:7.1f} CPU ms {100 * cpu / cpu_ms:5.0f} %")
    parameters = sum(parameter.nbytes for parameter in trainer.scene.gaussians.values()) / N
    fixed = (trainer.scene.anchors.nbytes + trainer.scene.footprints.nbytes) / N
    print(f"  bytes per Gaussian: {parameters + fixed:.0f} kept, {3 * parameters:.0f} for gradients and Adam's moments")
    del trainer
    before = peak_bytes()
    random_trainer(N_LARGE)._train_step()
    growth = (peak_bytes() - before) / (N_LARGE - N)
    print(f"  peak memory of a step grows by {growth:.0f} bytes per Gaussian ({N} to {N_LARGE})")


if __name__ == "__main__":
    main()
