"""Fit dynamic control points to tracks of dynamic pixels (stage 1)."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from stages.control import sightings, tracks
from stages.control.options import ControlOptions
from stages.shared import cli, images
from stages.shared.artifacts import read_dense, read_json, read_metadata
from stages.shared.cameras import Cameras, read_cameras
from stages.shared.cli import In, Out
from stages.shared.log import logger
from stages.shared.masks import read_masks_on_grid
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.split import held_out

if TYPE_CHECKING:
    from stages.deformation.motion_models import Deformation


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    masks: Annotated[Path, In("folder of dynamic masks, frame_0001.png ...")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    depth: Annotated[Path, In("ba/depth.arrow")],
    scene: Annotated[Path, In("scene.json: whether anything moves, and how")],
    points: Annotated[Path, Out("control points: x y z radius in the canonical frame")],
    deformation: Annotated[Path, Out("motion model and its residuals, safetensors")],
    figure: Annotated[Path, Out("picture for the report")],
    options: ControlOptions,
) -> str:
    """Fit dynamic control points to tracks of dynamic pixels (stage 1).

    Dynamic pixels are tracked by flow through the training frames only and lifted by depth. The canonical frame is the
    one whose tracks are observed most; control points are spread over it and their motion is fitted in the image
    plane. If nothing moves, nothing can be tracked or the poses failed, no control point is written; metadata and log
    give the reason.
    """
    from stages.control.figure import trajectories
    from stages.deformation.point_files import save_deformation, save_points

    content, cameras = read_sequence(sequence), read_cameras(poses)
    model, metadata = _fit(content, cameras, (flow, masks, depth), read_json(scene), options)
    logger.info("control points: %s", metadata)
    save_points(points, model, {"status": metadata["status"]})
    save_deformation(deformation, model, metadata)
    images.write_image(figure, trajectories(content, cameras, model))
    if model is None:
        return f"no control points: {metadata['status']}"
    return f"{len(model.points)} control points, residual {metadata['median_px']:.2f} px"


def _fit(
    sequence: Sequence, cameras: Cameras, files: tuple[Path, Path, Path], needs: dict[str, Any], options: ControlOptions
) -> tuple["Deformation | None", dict[str, Any]]:
    """The motion of the control points, None without any, and what the files say of it.

    Args:
        files: flow, masks and depth. needs: the content of scene.json.
    """
    from stages.control import stage1

    failed = "failed" in cameras.status
    if failed or not needs["dynamic"]["needed"]:
        status = "the poses failed" if failed else "the scene has no moving parts"
        return None, {"status": status, "arap_weight": 0.0, "region": options.region}
    seen = _sightings(sequence, *files, cameras, options)
    model, metadata = stage1.fit_sightings(seen, cameras, needs["non_rigid"]["arap_weight"], options)
    if metadata["status"] != "fitted":
        logger.warning("control points: %s; look at the figure and the residual in the metadata", metadata["status"])
    return model, metadata


def _sightings(
    sequence: Sequence, flow: Path, masks: Path, depth: Path, cameras: Cameras, options: ControlOptions
) -> sightings.Sightings:
    """Track dynamic pixels through the training frames and lift them to 3D."""
    T = len(sequence.frames)
    is_training = ~held_out(T, options)
    pairs, scale = read_dense(flow), float(read_metadata(flow)["scale"])
    links = tracks.training_links(pairs["source"], pairs["target"], pairs["flow"], is_training, pairs.release)
    if links.missing:
        logger.warning("no flow edge for %s: tracks end there; add the offset to flow.offsets", links.missing)
    h, w = pairs["flow"].shape[1:3]
    training_masks = np.ones((len(links.frames), h, w), bool)
    if options.region == "dynamic":
        training_masks = read_masks_on_grid(masks, sequence, links.frames, (w, h))
        training_masks &= cameras.masks_used[links.frames, None, None]
    followed = tracks.track_dynamic_pixels(links, training_masks, options.track_stride_px)
    dense, stride_px = read_dense(depth), float(read_metadata(depth)["stride_px"])
    inverse_depth, variance = dense["inverse_depth"][links.frames], dense["variance"][links.frames]
    return sightings.lift(followed, links.frames, T, scale, inverse_depth, variance, stride_px, cameras)


if __name__ == "__main__":
    cli.run(main)
