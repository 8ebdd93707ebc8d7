"""Stage 2: Gaussians from depth and masks, trained on the training frames with the motion of the control points."""

from pathlib import Path
from typing import Annotated

from stages.gaussians.options import GaussiansOptions
from stages.shared import cli
from stages.shared.cli import In, Out


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    masks: Annotated[Path, In("folder of refined dynamic masks")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    depth: Annotated[Path, In("ba/depth.arrow")],
    scene: Annotated[Path, In("scene.json: which effects the scene needs")],
    points: Annotated[Path, In("control/points.parquet")],
    deformation: Annotated[Path, In("control/deformation.safetensors")],
    ply: Annotated[Path, Out("canonical splats for viewers")],
    model: Annotated[Path, Out("the whole 4D model")],
    convergence: Annotated[Path, Out("table of step, loss, PSNR, Gaussians, seconds")],
    figure: Annotated[Path, Out("picture for the report: renders beside frames, PSNR over steps")],
    options: GaussiansOptions,
) -> None:
    """Train the 4D Gaussian scene on all frames but the held-out ones.

    Gaussians start from the depth of several frames and are labelled static or dynamic once, by a vote of the masks.
    Static Gaussians never move. A killed training resumes from the checkpoint beside the model.
    """
    import numpy as np
    import torch

    from stages.control.deformation import load_deformation
    from stages.gaussians.checkpoint import Checkpoint
    from stages.gaussians.figure import training_figure, write_figure
    from stages.gaussians.initialise import cloud_within, near_plane_of
    from stages.gaussians.inputs import canonical_row, read_observations
    from stages.gaussians.model import GaussianScene, scene_tensors
    from stages.gaussians.observations import with_mover_depth
    from stages.gaussians.optimise import Trainer
    from stages.gaussians.ply import write_ply
    from stages.gaussians.rasterize import backend_name, choose_device
    from stages.shared.artifacts import read_json, write_model, write_table
    from stages.shared.log import logger

    device = choose_device(options.device)
    needs = read_json(scene)
    motion = load_deformation(deformation, points) if needs["dynamic"]["needed"] else None
    seen = read_observations(sequence, masks, poses, depth, options)
    if motion is None:
        logger.info("no control points: every Gaussian is static, the masks are not used")
        canonical = len(seen.images) // 2
    else:
        seen = with_mover_depth(seen, motion)
        canonical = canonical_row(seen, sequence, deformation)
    sh_degree = needs["view_dependent"]["sh_degree"]
    cloud, stride_px = cloud_within(
        seen, motion, canonical, options.stride_px, options.neighbours, sh_degree, options.max_gaussians
    )
    if stride_px > options.stride_px:
        logger.warning("one Gaussian per %d px, not %d, to stay within max_gaussians", stride_px, options.stride_px)
    background = torch.as_tensor(seen.images.mean(axis=(0, 1, 2)))
    gaussians = GaussianScene(cloud, motion, background, near_plane_of(seen), options.neighbours).to(device)
    counts = (len(cloud.means), gaussians.n_static, len(cloud.means) - gaussians.n_static)
    logger.info("%s; %d Gaussians to start with: %d static, %d dynamic", backend_name(device), *counts)

    trainer = Trainer(gaussians, seen, options, needs["non_rigid"]["arap_weight"])
    checkpoint = Checkpoint(model, [sequence, masks, poses, depth, scene, points, deformation], options)
    checkpoint.resume(trainer)
    trainer.run(checkpoint.save_sometimes)

    tensors, settings = scene_tensors(gaussians)
    write_table(convergence, vars(trainer.history), {"units": "seconds of training, dB", "device": str(device)})
    write_figure(figure, training_figure(trainer, seen))
    write_ply(ply, *(tensors[name] for name in ("means", "quats", "log_scales", "logits", "sh")))
    write_model(
        model, tensors, settings | {"median_depth": float(np.median(seen.depths)), "options": options.model_dump()}
    )
    checkpoint.remove()


if __name__ == "__main__":
    cli.run(main)
