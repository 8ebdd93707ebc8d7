"""Render the trained scene at any time from any camera."""

from pathlib import Path
from typing import Annotated

import numpy as np

from stages.render.options import ViewOptions
from stages.shared import cli
from stages.shared.artifacts import read_metadata, read_table
from stages.shared.cli import In, Out
from stages.shared.errors import complete


def main(
    model: Annotated[Path, In("gaussians/model.safetensors, or model_half.safetensors")],
    cameras: Annotated[Path, In("table laid out as ba/poses.parquet; a column `time` (0..1) is optional")],
    output: Annotated[Path, Out("folder of frame_0001.png ..., one per row of the table, numbered as its frames")],
    options: ViewOptions,
) -> None:
    """Render one image per camera of a table and, with --splats, write the splats at its time as PLY.

    The time of an image is --at-time if set, else the column `time` of the table; without both, the rows are spread
    evenly over 0..1. Poses are camera-from-world in scene units; intrinsics are in pixels of the image to render.
    """
    from stages.render.shots import Shot, load_scene, take
    from stages.shared.atomic import atomic_folder
    from stages.shared.cameras import read_cameras
    from stages.shared.images import write_image
    from stages.shared.split import frame_times
    from stages.splatting.model_files import write_splats

    eyes, settings = read_cameras(cameras), read_metadata(model)
    with complete(model, "a model of the Gaussians", "give gaussians/model.safetensors"):
        width, height = options.width_px or settings["width"], options.height_px or settings["height"]
    T = len(eyes.numbers)
    times = read_table(cameras).get("time", frame_times(T) if T > 1 else np.zeros(T))
    if options.at_time is not None:
        times = np.full(T, options.at_time)
    scene = load_scene(model, options.device)
    with atomic_folder(output, ("frame_*.png", "frame_*.ply")) as folder:
        for number, time, pose, K in zip(eyes.numbers, times, eyes.cam_from_world, eyes.Ks, strict=True):
            shot = Shot("", int(number), float(time), pose, K)
            image = take(scene, shot, width, height)
            write_image(folder / f"frame_{number:04d}.png", image)
            if options.splats:
                write_splats(folder / f"frame_{number:04d}.ply", scene, float(time))


if __name__ == "__main__":
    cli.run(main)
