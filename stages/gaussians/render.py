"""Render the trained scene: training, held-out, novel and right-eye views, and a fly-through."""

from pathlib import Path
from typing import Annotated

import numpy as np

from stages.gaussians.options import RenderOptions
from stages.shared import cli
from stages.shared.cli import In, Out
from stages.shared.sequences import Sequence

SECONDS_PER_FRAME = 1 / 12


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    model: Annotated[Path, In("gaussians/model.safetensors")],
    output: Annotated[Path, Out("folder of renders: train, test, novel, right")],
    video: Annotated[Path, Out("fly-through as GIF")],
    options: RenderOptions,
) -> None:
    """Render every frame at its estimated pose and time, a fly-through, and the right eye where its truth is known.

    During the fly-through time runs from 0 to 1 while the camera circles around the estimated path.
    """
    import torch

    from stages.gaussians.figure import to_uint8
    from stages.gaussians.inputs import frame_times, read_usable_cameras
    from stages.gaussians.model import scene_from_tensors
    from stages.gaussians.rasterize import backend_name, choose_device
    from stages.gaussians.video import write_gif
    from stages.gaussians.views import novel_path
    from stages.shared.artifacts import atomic_folder, read_metadata, read_model
    from stages.shared.images import write_image
    from stages.shared.log import logger, progress
    from stages.shared.sequences import read_sequence
    from stages.shared.split import held_out

    device = choose_device(options.device)
    logger.info("rendering by %s", backend_name(device))
    content, cameras, metadata = read_sequence(sequence), read_usable_cameras(poses), read_metadata(model)
    scene = scene_from_tensors(read_model(model), metadata).to(device)
    times, T = frame_times(len(content.frames)), len(content.frames)

    @torch.no_grad()
    def render(time: float, cam_from_world: np.ndarray, K: np.ndarray) -> np.ndarray:
        viewmat, camera = torch.as_tensor(cam_from_world, device=device), torch.as_tensor(K, device=device)
        view = scene.render(float(time), viewmat, camera, content.width, content.height)
        return to_uint8(view.colour[0].cpu().numpy())

    is_test = held_out(T, options)
    moments = np.linspace(0, 1, options.novel_views)
    distance = float(metadata["median_depth"])
    path = novel_path(cameras.cam_from_world, moments, options.orbit_share * distance, distance)
    jobs = [
        ("test" if is_test[k] else "train", content.numbers[k], times[k], cameras.cam_from_world[k], cameras.Ks[k])
        for k in range(T)
    ]
    jobs += [("novel", n + 1, moments[n], path[n], cameras.Ks[0]) for n in range(len(moments))]
    rows, right = right_cameras(content, cameras.cam_from_world)
    jobs += [("right", content.numbers[k], times[k], eye, cameras.Ks[k]) for k, eye in zip(rows, right, strict=True)]
    novel = []
    with atomic_folder(output) as folder:
        for split, number, time, cam_from_world, K in progress(jobs, "rendering"):
            image = render(time, cam_from_world, K)
            write_image(folder / split / f"frame_{number:04d}.png", image)
            if split == "novel":
                novel.append(image)
    write_gif(video, novel, SECONDS_PER_FRAME * len(novel))


def right_cameras(content: Sequence, cam_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames [n] with a true right eye and its cameras [n, 4, 4] in our world; none without truth or scale."""
    from stages.gaussians.views import right_eye
    from stages.shared import lie, sintel
    from stages.shared.alignment import DegenerateError
    from stages.shared.log import logger

    both = set(content.truth.get("camdata_right", {})) & set(content.truth.get("clean_right", {}))
    rows = np.array([k for k, number in enumerate(content.numbers) if number in both], int)
    if len(rows) == 0 or not content.has_truth("camdata_left"):
        return rows[:0], np.zeros((0, 4, 4))

    def true_cameras(kind: str, frames: np.ndarray) -> np.ndarray:
        poses = [sintel.read_cam(content.truth[kind][content.numbers[k]])[1] for k in frames]
        return lie.from_parts(np.stack(poses)[:, :, :3], np.stack(poses)[:, :, 3])

    try:
        left = true_cameras("camdata_left", np.arange(len(content.numbers)))
        return rows, right_eye(cam_from_world, left, true_cameras("camdata_right", rows), rows)
    except DegenerateError as error:
        logger.warning("no right-eye views: the baseline has no scale in our world (%s)", error)
        return rows[:0], np.zeros((0, 4, 4))


if __name__ == "__main__":
    cli.run(main)
