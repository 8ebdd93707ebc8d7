"""The number of threads changes no byte: sums go over chunks whose number and order do not depend on it."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gaussian_scene as square
import torch
from ba_files import outputs, write_inputs
from conftest import REPO
from synthetic import flow_arrays, make_scene

from stages.ba.__main__ import main as solve
from stages.ba.options import BAOptions
from stages.deformation.point_files import save_deformation, save_points
from stages.deformation.splines import at_times
from stages.shared.artifacts import read_metadata, read_model, read_table
from stages.splatting.cloud import Cloud
from stages.splatting.gaussian_model import GaussianScene

THREADS = (1, 2, 4)


def compiled() -> set[Path]:
    """The kernels in the cache."""
    return set(Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbc"))


def run_on_threads(folder: Path, stage: str, inputs: dict[str, Path], written: dict[str, str], *options: str) -> None:
    """A stage on 1, 2 and 4 threads, which writes into folders of these names; all must write alike.

    A process that compiles its kernels and one that loads them differ in the last digits: a first run that compiled
    some is repeated.
    """

    def run(threads: int) -> None:
        paths = inputs | {name: folder / str(threads) / file for name, file in written.items()}
        flags = [str(part) for name, path in paths.items() for part in (f"--{name.replace('_', '-')}", path)]
        environment = os.environ | {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
        command = [sys.executable, "-m", f"stages.{stage}", *flags, *options]
        done = subprocess.run(command, cwd=REPO, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    before = compiled()
    run(THREADS[0])
    for threads in THREADS if compiled() != before else THREADS[1:]:
        run(threads)
    one, *others = (folder / str(threads) for threads in THREADS)
    for file in written.values():
        for other in others:
            if file.endswith((".parquet", ".safetensors")):  # one tells seconds, one keeps its metadata in no order
                assert contents(other / file) == contents(one / file), f"{file}, {other.name} threads"
            else:
                assert (other / file).read_bytes() == (one / file).read_bytes(), f"{file}, {other.name} threads"


def contents(path: Path) -> dict[str, object]:
    """Columns or tensors as bytes, and the metadata."""
    columns = read_table(path) if path.suffix == ".parquet" else read_model(path)
    found: dict[str, object] = {name: values.tolist() for name, values in columns.items()} | read_metadata(path)
    for decision in ("zoom", "rolling_shutter"):
        numbers = found.pop(decision, {})
        found |= {f"{decision} {name}": value for name, value in numbers.items()}  # type: ignore[attr-defined]
    return {name: value for name, value in found.items() if not name.endswith("seconds")}


def test_motion_prior_from_flow_and_from_cameras(tmp_path: Path) -> None:
    scene = make_scene(T=6, disc_radius=0.6)
    files = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic)
    masks = files.pop("masks")
    written = {"output": "prior.arrow", "figure": "motion.png"}
    run_on_threads(tmp_path / "flow", "motion", files, written)
    solve(**files, masks=masks, **(paths := outputs(tmp_path)), options=BAOptions())
    before = {"previous_poses": paths["poses"], "previous_depth": paths["depth"]}
    run_on_threads(tmp_path / "cameras", "motion", files | before, written)


def test_adjustment(tmp_path: Path) -> None:
    scene = make_scene(T=8, disc_radius=0.6)
    files = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic)
    written = {name: path.name for name, path in outputs(tmp_path).items() if name != "figure"}
    figure = {"figure": tmp_path / "ba.png"}  # it draws seconds
    run_on_threads(tmp_path, "ba", files | figure, written, "--stride-px", "4", "--depth-stride-px", "2")


def test_training(tmp_path: Path) -> None:
    square.write_artifacts(tmp_path)
    save_points(points := tmp_path / "points.parquet", square.true_motion(), {})
    said = {"canonical_frame": square.T // 2 + 1, "arap_weight": 0.01, "region": "dynamic"}
    save_deformation(deformation := tmp_path / "deformation.safetensors", square.true_motion(), said)
    names = {"sequence": "sequence.json", "masks": "masks", "poses": "poses.parquet", "depth": "depth.arrow"}
    files = {name: tmp_path / file for name, file in names.items()}
    files |= {"scene": tmp_path / "scene.json", "points": points, "deformation": deformation}
    written = {"ply": "gaussians.ply", "model": "model.safetensors", "half": "model_half.safetensors"}
    written |= {"convergence": "convergence.parquet", "figure": "figure.png"}
    run_on_threads(tmp_path, "gaussians", files, written, "--steps", "12", "--stride-px", "1", "--device", "cpu")


def on_torch_threads(values: Callable[[], list[torch.Tensor]]) -> list[list[bytes]]:
    """What a function gives with each number of torch's threads, as bytes."""
    before, found = torch.get_num_threads(), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        found.append([tensor.detach().numpy().tobytes() for tensor in values()])
    torch.set_num_threads(before)
    return found


def test_motion_of_control_points_between_frames() -> None:
    """A product of matrices of this shape is rounded by the number of threads."""
    random = torch.Generator().manual_seed(0)
    table, basis, g = (torch.randn(*shape, generator=random) for shape in ((7, 512, 7), (2, 7), (2, 512, 7)))

    def motion() -> list[torch.Tensor]:
        knots = table.clone().requires_grad_()
        return [values := at_times(basis, knots), *torch.autograd.grad(values, knots, g)]

    one, *others = on_torch_threads(motion)
    assert others == [one, one]


def test_image_of_more_gaussians_than_one_thread_takes() -> None:
    """Torch splits more than 32768 numbers; beside whole vectors, its exp and sigmoid round otherwise."""
    N, random = 33_001, torch.Generator().manual_seed(0)
    logits = 3 * torch.randn(N, generator=random)  # with these, number 16492 differs
    place, scales, quats, sh = (torch.randn(N, k, generator=random) for k in (3, 3, 4, 3))
    means = place * torch.tensor([1.0, 0.7, 0.3]) + torch.tensor([0.0, 0.0, 4.0])
    means[16_492] = torch.tensor([0.0, 0.0, 1.0])  # in front of all others
    still = torch.zeros(N, dtype=torch.bool)
    cloud = Cloud(means, torch.ones(N), 0.3 * scales - 4.5, quats, logits, sh[:, None], still)
    scene = GaussianScene(cloud, None, torch.zeros(3), 0.1, neighbours=4)
    pose, K = torch.tensor(square.cameras()[0]), torch.tensor(square.K)

    def image() -> list[torch.Tensor]:
        colour = scene.render(0.0, pose, K, square.WIDTH, square.HEIGHT).colour
        return [
            colour,
            *torch.autograd.grad(
                colour.sum(), [scene.gaussians[name] for name in ("log_scales", "quats", "logits", "sh_dc")]
            ),
        ]

    one, *others = on_torch_threads(image)
    assert others == [one, one]
