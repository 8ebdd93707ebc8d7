"""Render the trained scene: training, held-out, novel and right-eye views, and a fly-through."""

from pathlib import Path
from typing import Annotated

from stages.render.options import RenderOptions
from stages.shared import cli
from stages.shared.artifacts import read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.cli import In, Out
from stages.shared.log import progress
from stages.shared.pace import seconds_per_frame
from stages.shared.sequences import read_sequence

FILES = tuple(f"{split}/frame_*.png" for split in ("train", "test", "novel", "right"))


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    model: Annotated[Path, In("gaussians/model.safetensors")],
    output: Annotated[Path, Out("folder of renders: train, test, novel, right")],
    video: Annotated[Path, Out("fly-through as GIF")],
    options: RenderOptions,
) -> str:
    """Render every frame at its estimated pose and time, a fly-through, and the right eye if its true camera is known.

    Frames, and the right eye of the final pass, have the motion blur that the model was trained with; other views are
    sharp. In the fly-through the camera circles around the estimated path while time runs from 0 to 1. It lasts as long
    as the video, within what is bearable.
    """
    from stages.render.shots import load_scene, planned_shots, take
    from stages.render.video import write_gif
    from stages.shared.atomic import atomic_folder
    from stages.shared.images import write_image

    content, cameras = read_sequence(sequence), read_cameras(poses)
    trained = read_metadata(model)
    open_for = float(trained["shutter"]) if "shutter" in trained else None
    shots = planned_shots(content, cameras, float(trained["median_depth"]), options, open_for)
    scene = load_scene(model, options.device)
    novel = []
    with atomic_folder(output, FILES) as folder:
        for shot in progress(shots, "rendering"):
            image = take(scene, shot, content.width, content.height)
            write_image(folder / shot.split / f"frame_{shot.number:04d}.png", image)
            if shot.split == "novel":
                novel.append(image)
    write_gif(video, novel, len(novel) * seconds_per_frame(content.times_s, len(novel)))
    return f"{len(shots)} views"


if __name__ == "__main__":
    cli.run(main)
