"""The interactive viewer: the 4D scene as one HTML page that opens from disk."""

from pathlib import Path
from typing import Annotated

from stages.shared import cli
from stages.shared.cameras import read_cameras
from stages.shared.cli import In, Out
from stages.shared.sequences import read_sequence


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    model: Annotated[Path, In("gaussians/model.safetensors")],
    output: Annotated[Path, Out("the page")],
    masks: Annotated[Path | None, In("folder of dynamic masks, to tell the movers apart")] = None,
) -> str:
    """Write a page that shows the 4D scene from any view at any time, beside the input frames.

    The page needs neither network nor other files, but a browser with WebGL2. docs/viewer.md describes it.
    """
    import numpy as np

    from stages.shared.artifacts import read_metadata, read_model
    from stages.shared.atomic import atomic
    from stages.shared.drawing import spread
    from stages.shared.errors import InputError, complete
    from stages.shared.images import read_rgb
    from stages.shared.log import progress
    from stages.shared.split import frame_times
    from stages.splatting.model_files import scene_from_tensors
    from stages.viewer.instances import elected, instance_votes, voting_frames
    from stages.viewer.packing import pack_scene
    from stages.viewer.page import MOST_PICTURES, encoded, render_page

    frames, cameras = read_sequence(sequence), read_cameras(poses)
    times = frame_times(len(frames.frames))
    if len(cameras.numbers) != len(times):
        raise InputError(poses, f"{len(times)} cameras", f"{len(cameras.numbers)}", "give the poses of this sequence")
    with complete(model, "a model of the Gaussians", "give gaussians/model.safetensors"):
        scene = scene_from_tensors(read_model(model), read_metadata(model))
    instances = np.zeros(len(scene.anchors) - scene.n_static, np.uint8)
    if masks is not None and len(instances):
        instances = elected(instance_votes(scene, cameras, times, frames, masks, voting_frames(len(times))))
    arrays, numbers = pack_scene(scene, cameras, times, instances)
    shown = spread(len(times), MOST_PICTURES)
    pictures = encoded(read_rgb(frames.frames[k]) for k in progress(shown, "input frames"))
    page = render_page(frames.name, arrays, numbers, (frames.width, frames.height), pictures)
    with atomic(output) as partial:
        partial.write_text(page, encoding="utf-8")
    return f"{len(scene.anchors)} Gaussians, {len(times)} frames, {len(page.encode()) / 1e6:.1f} MB"


if __name__ == "__main__":
    cli.run(main)
