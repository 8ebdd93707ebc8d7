"""The untrained scene, its training frames and its optimiser, from the files of the earlier stages."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.deformation.motion_models import Deformation
from stages.deformation.point_files import load_deformation
from stages.gaussians.fog import cleared_of_fog
from stages.gaussians.initial_cloud import cloud_within
from stages.gaussians.inputs import canonical_row, read_observations
from stages.gaussians.lifting import near_plane_of
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.shadows import moving_shadows
from stages.gaussians.training_frames import TrainingFrames, with_movers, with_smear
from stages.shared.artifacts import read_json, read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.frame_store import PackedMasks
from stages.shared.log import logger
from stages.splatting.atmosphere import Atmosphere
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.pose_table import PoseTable
from stages.splatting.rasterize import backend_name, choose_device
from stages.splatting.shutter import Shutter


@dataclass(frozen=True)
class Beginning:
    """The trainer at step 0, what it trains on, and what the metadata of the model say about the inputs.

    Attributes:
        canonical: index of the canonical frame among the training frames.
    """

    trainer: Trainer
    seen: TrainingFrames
    canonical: int
    about: dict[str, Any]


def begin(
    sequence: Path,
    masks: Path,
    poses: Path,
    depth: Path,
    scene: Path,
    points: Path,
    deformation: Path,
    options: GaussiansOptions,
    scratch: Path,
) -> Beginning:
    """The untrained scene and its optimiser from the inputs of the stage.

    Args:
        scratch: folder for temporary files.
    """
    needs, failed = read_json(scene), "failed" in read_cameras(poses).status
    if failed:
        logger.warning("gaussians: the poses failed: a static scene is trained before a camera at rest")
    about: dict[str, Any] = {"status": "poses failed" if failed else "trained"}
    seen = read_observations(sequence, masks, poses, depth, options, scratch)
    options = options.of_length(len(seen.images))
    if 0 < options.steps < len(seen.images):
        few = "gaussians: %d steps see as many of %d training frames; raise gaussians: {steps: ...}"
        logger.warning(few, options.steps, len(seen.images))
    seen, motion, canonical = _with_motion(seen, needs, (sequence, points, deformation), scratch)
    gaussians = _new_scene(seen, motion, canonical, needs, options)
    if needs["motion_blur"]["needed"] and not failed:
        about["shutter"] = float(needs["motion_blur"]["shutter"])
        seen = _with_smear(seen, gaussians, poses, about["shutter"])
    trainer = Trainer(gaussians, seen, options, read_metadata(deformation)["arap_weight"])
    return Beginning(trainer, seen, canonical, about)


def _with_motion(
    seen: TrainingFrames, needs: dict[str, Any], files: tuple[Path, Path, Path], scratch: Path
) -> tuple[TrainingFrames, Deformation | None, int]:
    """The training frames with depth of the movers, the motion (None: static), and the index of the canonical frame.

    Args:
        files: sequence, points and deformation. scratch: folder for temporary files.
    """
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


def _with_smear(seen: TrainingFrames, scene: GaussianScene, poses: Path, shutter: float) -> TrainingFrames:
    """The training frames with the moments over which each is averaged."""
    cameras = read_cameras(poses)
    seen = with_smear(seen, scene, Shutter(shutter, cameras.cam_from_world, cameras.Ks))
    counts = [len(seen.picture(f).times) for f in range(len(seen.images))]
    logger.info(
        "shutter open for %.2f frames: %.1f moments per frame, at most %d", shutter, np.mean(counts), max(counts)
    )
    return seen


def _new_scene(
    seen: TrainingFrames,
    motion: Deformation | None,
    canonical: int,
    needs: dict[str, Any],
    options: GaussiansOptions,
) -> GaussianScene:
    """The untrained scene with the effects that scene.json decides on."""
    device, neighbours = choose_device(options.device), options.neighbours
    degree, most = needs["view_dependent"]["sh_degree"], options.max_gaussians
    air, every = _atmosphere(needs), options.movers_every
    lifted = seen if air is None else cleared_of_fog(seen, air)
    cloud, stride_px = cloud_within(lifted, motion, canonical, options.stride_px, neighbours, degree, most, every)
    if stride_px > options.stride_px:
        logger.warning("one Gaussian per %d px, not %d, to stay within max_gaussians", stride_px, options.stride_px)
    background = torch.as_tensor(seen.mean_colour)
    tables = tables_over_time(seen, motion, needs, options)
    shadows = moving_shadows(lifted, cloud) if needs["moving_shadows"]["needed"] else None
    scene = GaussianScene(cloud, motion, background, near_plane_of(seen), neighbours, *tables, air, shadows).to(device)
    counts = (len(cloud.means), scene.n_static, len(cloud.means) - scene.n_static)
    logger.info("%s; %d Gaussians to start with: %d static, %d dynamic", backend_name(device), *counts)
    return scene


def _atmosphere(needs: dict[str, Any]) -> Atmosphere | None:
    """The fog that scene.json measured; None where it is not modelled."""
    decision = needs["atmosphere"]
    if not decision["needed"] or decision["extinction"] <= 0:
        return None
    logger.info("fog: extinction %.4g per scene unit, airlight %s", decision["extinction"], decision["airlight"])
    return Atmosphere(decision["extinction"], torch.tensor(decision["airlight"]))


def tables_over_time(
    seen: TrainingFrames, motion: Deformation | None, needs: dict[str, Any], options: GaussiansOptions
) -> tuple[ColourTable | None, Exposure | None, PoseTable | None]:
    """Colours of the control points, exposure and pose corrections; None for each that is not modelled."""
    times = torch.as_tensor(seen.times)
    channels = 3 if needs["white_balance"]["needed"] else int(needs["exposure"]["needed"])
    return (
        ColourTable(times, len(motion.points)) if motion is not None and options.colour_table else None,
        Exposure(times, channels) if channels else None,
        PoseTable(times, seen.median_depth) if options.refine_poses else None,
    )
