"""Render the trained scene: training, held-out, novel and right-eye views, and a fly-through."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from stages.gaussians.options import RenderOptions
from stages.shared import cli, lie, sintel
from stages.shared.alignment import DegenerateError
from stages.shared.artifacts import read_metadata, read_model
from stages.shared.cameras import Cameras
from stages.shared.cli import In, Out
from stages.shared.log import logger, progress
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.split import held_out

SECONDS_PER_FRAME = 1 / 12


@dataclass(frozen=True)
class Shot:
    """One image to render: into which folder, under which number, when (0..1) and from which camera."""

    split: str
    number: int
    time: float
    cam_from_world: np.ndarray
    K: np.ndarray


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
    from stages.gaussians.inputs import read_usable_cameras
    from stages.gaussians.video import write_gif
    from stages.shared.artifacts import atomic_folder
    from stages.shared.images import write_image

    content, cameras = read_sequence(sequence), read_usable_cameras(poses)
    shots = planned_shots(content, cameras, float(read_metadata(model)["median_depth"]), options)
    render = _renderer(model, content, options)
    novel = []
    with atomic_folder(output) as folder:
        for shot in progress(shots, "rendering"):
            image = render(shot)
            write_image(folder / shot.split / f"frame_{shot.number:04d}.png", image)
            if shot.split == "novel":
                novel.append(image)
    write_gif(video, novel, SECONDS_PER_FRAME * len(novel))


def planned_shots(content: Sequence, cameras: Cameras, distance: float, options: RenderOptions) -> list[Shot]:
    """Every frame at its pose, the fly-through around a point at `distance` (scene units), and the true right eye."""
    from stages.gaussians.inputs import frame_times
    from stages.gaussians.views import novel_path

    T = len(content.frames)
    times, is_test = frame_times(T), held_out(T, options)
    shots = [
        Shot("test" if is_test[k] else "train", content.numbers[k], times[k], cameras.cam_from_world[k], cameras.Ks[k])
        for k in range(T)
    ]
    moments = np.linspace(0, 1, options.novel_views)
    path = novel_path(cameras.cam_from_world, moments, options.orbit_share * distance, distance)
    shots += [Shot("novel", n + 1, moments[n], path[n], cameras.Ks[0]) for n in range(len(moments))]
    rows, eyes = right_cameras(content, cameras.cam_from_world)
    return shots + [
        Shot("right", content.numbers[k], times[k], eye, cameras.Ks[k]) for k, eye in zip(rows, eyes, strict=True)
    ]


def _renderer(model: Path, content: Sequence, options: RenderOptions) -> Callable[[Shot], np.ndarray]:
    """A function that renders a shot of the scene in `model` as [H, W, 3] uint8."""
    import torch

    from stages.gaussians.figure import to_uint8
    from stages.gaussians.model import scene_from_tensors
    from stages.gaussians.rasterize import backend_name, choose_device

    device = choose_device(options.device)
    logger.info("rendering by %s", backend_name(device))
    scene = scene_from_tensors(read_model(model), read_metadata(model)).to(device)

    @torch.no_grad()
    def render(shot: Shot) -> np.ndarray:
        viewmat, K = (torch.as_tensor(matrix, device=device) for matrix in (shot.cam_from_world, shot.K))
        view = scene.render(float(shot.time), viewmat, K, content.width, content.height)
        return to_uint8(view.colour[0].cpu().numpy())

    return render


def right_cameras(content: Sequence, cam_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames [n] with a true right eye and its cameras [n, 4, 4] in our world; none without truth or scale."""
    from stages.gaussians.views import right_eye

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
