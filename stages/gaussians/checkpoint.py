"""Checkpoints of the training: a killed run resumes from the last one and ends with the same result, bit for bit."""

import time
from pathlib import Path

import numpy as np
import torch

from stages.gaussians.densify import GradientRecord
from stages.gaussians.optimise import History, Trainer
from stages.gaussians.options import GaussiansOptions
from stages.shared import costs
from stages.shared.artifacts import read_metadata, read_model, unless_damaged, write_model
from stages.shared.digest import origin
from stages.shared.log import logger
from stages.splatting.cloud import select

INTERVAL_S = 20.0


class Checkpoint:
    """A hidden file beside the model. Only a run with the same inputs, options and code resumes from it."""

    def __init__(self, model: Path, inputs: list[Path], options: GaussiansOptions) -> None:
        self.path = model.with_name(f".{model.stem}.checkpoint.safetensors")
        self.origin = origin("stages.gaussians", inputs, options)
        self.saved_s = time.perf_counter()

    def resume(self, trainer: Trainer) -> None:
        """Set a new trainer to the saved step, if there is a checkpoint of the same run."""
        if not self.path.exists():
            return
        left = unless_damaged(lambda: (read_model(self.path), read_metadata(self.path)))
        if left is None:
            return
        arrays, metadata = left
        if metadata["origin"] != self.origin:
            logger.info("the checkpoint has other inputs, options or code: training starts at step 0")
            return
        costs.take_over(metadata["spent"])
        restore(trainer, arrays, int(metadata["n_static"]))
        logger.info("resumed at step %d of %d", trainer.step, trainer.options.steps)

    def save_sometimes(self, trainer: Trainer) -> None:
        """Save if the last checkpoint is older than INTERVAL_S."""
        if time.perf_counter() - self.saved_s > INTERVAL_S:
            about = {"origin": self.origin, "n_static": trainer.scene.n_static, "spent": costs.spent()}
            write_model(self.path, capture(trainer), about)
            self.saved_s = time.perf_counter()

    def remove(self) -> None:
        """Delete the file: the training is done."""
        self.path.unlink(missing_ok=True)


def capture(trainer: Trainer) -> dict[str, np.ndarray]:
    """The state of the training as arrays by name: parameters, Adam's moments, gradient record and history.

    The first three have the shapes of the trainer's tensors; a history has one entry per step.
    """
    tensors = {f"scene.{name}": value for name, value in trainer.scene.state_dict().items()}
    for group in trainer.optimiser.param_groups:
        for k, parameter in enumerate(group["params"]):
            state = trainer.optimiser.state[parameter]
            tensors |= {f"adam.{group['name']}.{k}.{key}": value for key, value in state.items()}
    tensors |= {"record.total": trainer.record.total, "record.views": trainer.record.views}
    arrays = {name: value.detach().cpu().numpy() for name, value in tensors.items()}
    return arrays | {f"history.{name}": np.array(values) for name, values in vars(trainer.history).items()}


def restore(trainer: Trainer, arrays: dict[str, np.ndarray], n_static: int) -> None:
    """Set a trainer of the same run to the state that `capture` returned.

    Args:
        n_static: number of static Gaussians, which come first.
    """
    scene, device = trainer.scene, trainer.device
    state = {name: torch.from_numpy(np.array(value)).to(device) for name, value in arrays.items()}
    scene_state = {name.removeprefix("scene."): value for name, value in state.items() if name.startswith("scene.")}
    N = len(scene_state["anchors"])
    blank = select(scene.cloud(), torch.zeros(N, dtype=torch.int64, device=device))
    blank.dynamic = torch.arange(N, device=device) >= n_static
    scene.set_cloud(blank)  # gives every tensor its size
    scene.load_state_dict(scene_state)
    if scene.shadows is not None:
        scene.shadows.bind(scene.anchors[:n_static])  # as when these became the anchors
    trainer.optimiser = trainer.new_optimiser()
    for group in trainer.optimiser.param_groups:
        for k, parameter in enumerate(group["params"]):
            prefix = f"adam.{group['name']}.{k}."
            moments = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
            trainer.optimiser.state[parameter] = moments
    trainer.record = GradientRecord(state["record.total"], state["record.views"])
    trainer.history = History(**{name: arrays[f"history.{name}"].tolist() for name in vars(trainer.history)})
    trainer.step = trainer.history.step[-1]
