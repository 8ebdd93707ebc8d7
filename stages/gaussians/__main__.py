"""Stage 2: Gaussians from depth and masks, trained on the training frames with the motion of the control points."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from stages.gaussians.options import GaussiansOptions
from stages.shared import cli
from stages.shared.artifacts import read_json, read_metadata, write_model, write_table
from stages.shared.cameras import read_cameras
from stages.shared.cli import In, Out
from stages.shared.log import logger

if TYPE_CHECKING:
    from stages.deformation.motion_models import Deformation
    from stages.gaussians.optimise import Trainer
    from stages.gaussians.training_frames import TrainingFrames
    from stages.splatting.atmosphere import Atmosphere
    from stages.splatting.colours import ColourTable
    from stages.splatting.gains import Exposure
    from stages.splatting.gaussian_model import GaussianScene
    from stages.splatting.pose_table import PoseTable


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
    from stages.gaussians.checkpoint import Checkpoint
    from stages.gaussians.inputs import read_observations
    from stages.gaussians.optimise import Trainer
    from stages.splatting.model_files import write_splats

    needs, failed = read_json(scene), "failed" in read_cameras(poses).status
    if failed:
        logger.warning("gaussians: the poses failed: a static scene is trained before a camera at rest")
    seen = read_observations(sequence, masks, poses, depth, options, model.parent)
    seen, motion, canonical = _with_motion(seen, needs, (sequence, points, deformation), model.parent)
    gaussians = _new_scene(seen, motion, canonical, needs, options)
    shutter = None if failed or not needs["motion_blur"]["needed"] else float(needs["motion_blur"]["shutter"])
    if shutter is not None:
        seen = _with_smear(seen, gaussians, poses, shutter)
    trainer = Trainer(gaussians, seen, options, read_metadata(deformation)["arap_weight"])
    checkpoint = Checkpoint(model, [sequence, masks, poses, depth, scene, points, deformation], options)
    checkpoint.resume(trainer)
    trainer.run(checkpoint.save_sometimes)
    _write_history(convergence, figure, trainer, seen)
    status: dict[str, Any] = {"status": "poses failed" if failed else "trained", "options": options.model_dump()}
    if shutter is not None:
        status["shutter"] = shutter
    _write_models((model, half), gaussians, seen, status)
    write_splats(ply, gaussians, float(seen.times[canonical]))
    checkpoint.remove()
    return _result(trainer, seen)


def _result(trainer: "Trainer", seen: "TrainingFrames") -> str:
    """The number of Gaussians and the PSNR over the last turn of all training frames, in a few words."""
    psnr_db = float(np.mean(trainer.history.psnr[-len(seen.images) :])) if trainer.history.psnr else float("nan")
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
) -> None:
    """The whole model, and the same in half precision."""
    from stages.splatting.model_files import scene_tensors

    model, half = paths
    tensors, settings = scene_tensors(scene)
    height, width = seen.size
    settings |= about | {"median_depth": seen.median_depth, "width": width, "height": height}
    _write_half(half, scene, seen, settings)
    write_model(model, tensors, settings)


def _write_half(path: Path, scene: "GaussianScene", seen: "TrainingFrames", settings: dict[str, Any]) -> None:
    """Write the scene in half precision; its metadata hold the PSNR of training frames and the loss against float32."""
    from stages.gaussians.optimise import training_psnr
    from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors

    tensors, small_settings = halved(scene_tensors(scene)[0], settings)
    small = scene_from_tensors(tensors, small_settings).to(scene.background.device)
    psnr_db = training_psnr(small, seen)
    loss_db = training_psnr(scene, seen) - psnr_db
    write_model(path, tensors, small_settings | {"training_psnr_db": psnr_db, "psnr_loss_db": loss_db})
    megabytes = path.stat().st_size / 1e6
    logger.info("half precision: %.2f MB, %.2f dB on training frames, %.3f dB lost", megabytes, psnr_db, loss_db)


def _with_motion(
    seen: "TrainingFrames", needs: dict[str, Any], files: tuple[Path, Path, Path], scratch: Path
) -> tuple["TrainingFrames", "Deformation | None", int]:
    """The training frames with depth of the movers, the motion (None: static), and the index of the canonical frame.

    Args:
        files: sequence, points and deformation. scratch: folder for temporary files.
    """
    from stages.deformation.point_files import load_deformation
    from stages.gaussians.inputs import canonical_row
    from stages.gaussians.training_frames import with_movers
    from stages.shared.frame_store import PackedMasks

    sequence, points, deformation = files
    motion = load_deformation(deformation, points) if needs["dynamic"]["needed"] else None
    if motion is None:
        logger.info("no control points: every Gaussian is static, the masks are not used")
        return seen, None, len(seen.images) // 2
    if read_metadata(deformation)["region"] == "whole":
        seen = replace(seen, masks=PackedMasks((f, np.ones(seen.size, bool)) for f in range(len(seen.masks))))
    masked = seen.masked.sum()
    seen = with_movers(seen, motion, scratch)
    lost = masked - seen.masked.sum()
    logger.info("%d of %d masked pixels are out of reach of the control points: static", lost, masked)
    return seen, motion, canonical_row(seen, sequence, deformation)


def _with_smear(seen: "TrainingFrames", scene: "GaussianScene", poses: Path, shutter: float) -> "TrainingFrames":
    """The training frames with the moments over which each is averaged."""
    from stages.gaussians.training_frames import with_smear
    from stages.splatting.shutter import Shutter

    cameras = read_cameras(poses)
    seen = with_smear(seen, scene, Shutter(shutter, cameras.cam_from_world, cameras.Ks))
    counts = [len(seen.picture(f).times) for f in range(len(seen.images))]
    logger.info(
        "shutter open for %.2f frames: %.1f moments per frame, at most %d", shutter, np.mean(counts), max(counts)
    )
    return seen


def _new_scene(
    seen: "TrainingFrames",
    motion: "Deformation | None",
    canonical: int,
    needs: dict[str, Any],
    options: GaussiansOptions,
) -> "GaussianScene":
    """The untrained scene with the effects that scene.json decides on."""
    import torch

    from stages.gaussians.fog import cleared_of_fog
    from stages.gaussians.initial_cloud import cloud_within
    from stages.gaussians.lifting import near_plane_of
    from stages.splatting.gaussian_model import GaussianScene
    from stages.splatting.rasterize import backend_name, choose_device

    device, neighbours = choose_device(options.device), options.neighbours
    degree, most = needs["view_dependent"]["sh_degree"], options.max_gaussians
    air, every = _atmosphere(needs), options.movers_every
    lifted = seen if air is None else cleared_of_fog(seen, air)
    cloud, stride_px = cloud_within(lifted, motion, canonical, options.stride_px, neighbours, degree, most, every)
    if stride_px > options.stride_px:
        logger.warning("one Gaussian per %d px, not %d, to stay within max_gaussians", stride_px, options.stride_px)
    background = torch.as_tensor(seen.mean_colour)
    tables = _tables_over_time(seen, motion, needs, options)
    scene = GaussianScene(cloud, motion, background, near_plane_of(seen), neighbours, *tables, air).to(device)
    counts = (len(cloud.means), scene.n_static, len(cloud.means) - scene.n_static)
    logger.info("%s; %d Gaussians to start with: %d static, %d dynamic", backend_name(device), *counts)
    return scene


def _atmosphere(needs: dict[str, Any]) -> "Atmosphere | None":
    """The fog that scene.json measured; None where it is not modelled."""
    import torch

    from stages.splatting.atmosphere import Atmosphere

    decision = needs["atmosphere"]
    if not decision["needed"] or decision["extinction"] <= 0:
        return None
    logger.info("fog: extinction %.4g per scene unit, airlight %s", decision["extinction"], decision["airlight"])
    return Atmosphere(decision["extinction"], torch.tensor(decision["airlight"]))


def _tables_over_time(
    seen: "TrainingFrames", motion: "Deformation | None", needs: dict[str, Any], options: GaussiansOptions
) -> tuple["ColourTable | None", "Exposure | None", "PoseTable | None"]:
    """Colours of the control points, exposure and pose corrections; None for each that is not modelled."""
    import torch

    from stages.splatting.colours import ColourTable
    from stages.splatting.gains import Exposure
    from stages.splatting.pose_table import PoseTable

    times = torch.as_tensor(seen.times)
    channels = 3 if needs["white_balance"]["needed"] else int(needs["exposure"]["needed"])
    return (
        ColourTable(times, len(motion.points)) if motion is not None and options.colour_table else None,
        Exposure(times, channels) if channels else None,
        PoseTable(times, seen.median_depth) if options.refine_poses else None,
    )


if __name__ == "__main__":
    cli.run(main)
