"""Stage 2: Gaussians from depth and masks, trained on the training frames with the motion of the control points."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from stages.gaussians.options import GaussiansOptions
from stages.shared import cli
from stages.shared.artifacts import write_model, write_table
from stages.shared.cli import In, Out
from stages.shared.log import logger

if TYPE_CHECKING:
    from stages.gaussians.optimise import Trainer
    from stages.gaussians.training_frames import TrainingFrames
    from stages.splatting.gaussian_model import GaussianScene


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    masks: Annotated[Path, In("folder of refined dynamic masks")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    depth: Annotated[Path, In("ba/depth.arrow")],
    scene: Annotated[Path, In("scene.json: which effects the scene needs")],
    points: Annotated[Path, In("control/points.parquet")],
    deformation: Annotated[Path, In("control/deformation.safetensors")],
    ply: Annotated[Path, Out("splats of the canonical frame for viewers")],
    model: Annotated[Path, Out("the whole 4D model")],
    half: Annotated[Path, Out("the same in half precision, with what that costs in its metadata")],
    convergence: Annotated[Path, Out("table of step, loss, PSNR, Gaussians, seconds")],
    figure: Annotated[Path, Out("picture for the report: renders beside frames, PSNR over steps")],
    options: GaussiansOptions,
) -> str:
    """Train the 4D Gaussian scene on all frames but the held-out ones.

    Gaussians are initialised from the depth of several frames and labelled static or dynamic once, by a vote of the
    masks. Static Gaussians never move. If the poses failed, the scene is trained as static before a camera at rest; log
    and metadata say so. A killed training resumes from the checkpoint beside the model.
    """
    from stages.gaussians.beginning import begin
    from stages.gaussians.checkpoint import Checkpoint
    from stages.splatting.model_files import write_splats

    inputs = (sequence, masks, poses, depth, scene, points, deformation)
    start = begin(*inputs, options, model.parent)
    trainer, seen = start.trainer, start.seen
    checkpoint = Checkpoint(model, list(inputs), options)
    checkpoint.resume(trainer)
    trainer.run(checkpoint.save_sometimes)
    _write_history(convergence, figure, trainer, seen)
    psnr_db = _write_models((model, half), trainer.scene, seen, start.about | {"options": options.model_dump()})
    write_splats(ply, trainer.scene, float(seen.times[start.canonical]))
    checkpoint.remove()
    return f"{len(trainer.scene.anchors)} Gaussians, {psnr_db:.1f} dB on training frames"


def _write_history(convergence: Path, figure: Path, trainer: "Trainer", seen: "TrainingFrames") -> None:
    """The table of all steps, and the picture for the report."""
    from stages.gaussians.figure import training_figure
    from stages.shared.images import write_figure

    about = {"units": "seconds of training, dB", "device": str(trainer.device)}
    write_table(convergence, vars(trainer.history), about)
    write_figure(figure, training_figure(trainer, seen))


def _write_models(
    paths: tuple[Path, Path], scene: "GaussianScene", seen: "TrainingFrames", about: dict[str, Any]
) -> float:
    """The whole model, and the same in half precision; returns the PSNR (dB) of training frames."""
    from stages.splatting.model_files import scene_tensors

    model, half = paths
    tensors, settings = scene_tensors(scene)
    height, width = seen.size
    settings |= about | {"median_depth": seen.median_depth, "width": width, "height": height}
    psnr_db = _write_half(half, scene, seen, settings)
    write_model(model, tensors, settings)
    return psnr_db


def _write_half(path: Path, scene: "GaussianScene", seen: "TrainingFrames", settings: dict[str, Any]) -> float:
    """Write the scene in half precision; its metadata hold the PSNR of training frames and the loss against float32.

    Returns:
        the PSNR (dB) in float32.
    """
    from stages.gaussians.optimise import training_psnr
    from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors

    tensors, small_settings = halved(scene_tensors(scene)[0], settings)
    small = scene_from_tensors(tensors, small_settings).to(scene.background.device)
    psnr_db, full_db = training_psnr(small, seen), training_psnr(scene, seen)
    loss_db = full_db - psnr_db
    write_model(path, tensors, small_settings | {"training_psnr_db": psnr_db, "psnr_loss_db": loss_db})
    megabytes = path.stat().st_size / 1e6
    logger.info("half precision: %.2f MB, %.2f dB on training frames, %.3f dB lost", megabytes, psnr_db, loss_db)
    return full_db


if __name__ == "__main__":
    cli.run(main)
