"""Render a scene file as an MPI-Sintel style sequence with exact ground truth."""

import contextlib
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from stages.shared import cli, sintel
from stages.shared.artifacts import write_json
from stages.shared.atomic import atomic_folder
from stages.shared.cameras import pixel_grid
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.log import logger, progress
from stages.simulate import frames
from stages.simulate.effect_models import Effects
from stages.simulate.exact_motion import Motion, motion
from stages.simulate.frames import Moment, Stage
from stages.simulate.keyframes import View
from stages.simulate.options import SimulateOptions
from stages.simulate.raycast import enclosing
from stages.simulate.scene import Scene, load_scene
from stages.simulate.stopwatch import Stopwatch

KINDS = (
    "clean",
    "final",
    "flow",
    "depth",
    "camdata_left",
    "occlusions",
    "invalid",
    "motion_mask",
    "mover_mask",
    "clean_right",
    "final_right",
    "camdata_right",
)
RIGHT_EVERY, FIRST_RIGHT = 4, 2
"""The final pass of the right eye is drawn of one frame in so many, from this one on: with motion blur it takes as long
as that of the left. By default none of these frames is held out from training."""
LENS = "distortion"
"""Kind of the truth of a lens, of scenes that have one: {"k1": ..., "k2": ...} of every frame."""
FILES = ("frame_*.png", "frame_*.flo", "frame_*.dpt", "frame_*.cam", "frame_*.json")


class RenderOptions(SimulateOptions):
    """Options of this script; `explain` is a flag only."""

    explain: bool = Field(False, description="print the effects that the scene simulates and the seconds of each")


def main(
    scene: Annotated[Path, In("scene file, e.g. stages/simulate/scenes/demo.yaml")],
    output: Annotated[Path, Out("folder that receives training/<kind>/<scene>/ and <scene>.json")],
    options: RenderOptions,
) -> str:
    """Render a scene: clean and final pass, flow, depth, cameras, occlusions, invalid, masks of motion, right eye."""
    drawn, name = load_scene(scene), scene.stem
    manifest = output / f"{name}.json"
    manifest.unlink(missing_ok=True)  # removed first, since it marks the sequence as complete
    if drawn.camera.distortion is None:  # of an earlier version of the scene
        for stale in (output / "training" / LENS / name).glob(FILES[-1]):
            stale.unlink()
    stage = frames.set_stage(drawn, options.seed)
    with contextlib.ExitStack() as stack:
        folders = {
            kind: stack.enter_context(atomic_folder(output / "training" / kind / name, FILES))
            for kind in kinds_of(drawn)
        }
        before = now = stage.moment(0)
        for frame in progress(range(drawn.frames), name):
            refuse_blocked_camera(stage, now, frame, scene)
            last = frame == drawn.frames - 1
            other = before if last else stage.moment(frame + 1)
            draw_frame(stage, frame, now, other, folders)
            before, now = now, other
    content = explanation(drawn, name, options.seed, stage.watch)
    write_json(manifest, content)
    logger.info("simulated: %s", content)
    if options.explain:
        print(explain(content))
    return f"{drawn.frames} frames of {drawn.width} x {drawn.height} px"


def refuse_blocked_camera(stage: Stage, now: Moment, frame: int, scene: Path) -> None:
    """Refuse a camera that is inside an object or under the ground.

    Raises:
        InputError: names the object and the frame.
    """
    inside = enclosing(stage.world, now.snapshot, now.view.centre)
    if inside is not None:
        found = f"the camera inside '{inside}' at frame {frame + 1}"
        raise InputError(f"{scene}: camera.keys", "free space around every camera", found, "move the keyframes")


def draw_frame(stage: Stage, frame: int, now: Moment, other: Moment, folders: dict[str, Path]) -> None:
    """Render and write one frame of every kind.

    Args:
        frame: 0-based index. now: the scene and the camera at that frame.
        other: those at the next frame; for the last frame at the one before, for the motion mask alone, without flow.
        folders: of the frames, by kind.
    """
    scene, watch = stage.scene, stage.watch
    with watch.measure("clean"):
        seen = frames.see(stage, now)
        clean = frames.develop(stage, now, seen, with_effects=False)
    with watch.measure("truth"):
        uv = pixel_grid(scene.height, scene.width).reshape(-1, 2)
        moved = motion(seen.hits, uv, stage.world, other.snapshot, other.view, now.view.K[0, 0])
    passes = {"clean": clean, "final": frames.final(stage, frame, now, seen, clean)}
    with watch.measure("right eye"):
        right, now_right = frames.right_eye(stage, now)
        seen_right = frames.see(right, now_right)
        passes["clean_right"] = frames.develop(right, now_right, seen_right, with_effects=False)
        if frame % RIGHT_EVERY == FIRST_RIGHT:
            passes["final_right"] = frames.final(right, frame, now_right, seen_right, passes["clean_right"])
    with watch.measure("writing"):
        stem = f"frame_{frame + 1:04d}"
        for kind, image in passes.items():
            write_image(folders[kind] / f"{stem}.png", frames.to_srgb(image))
        sintel.write_dpt(folders["depth"] / f"{stem}.dpt", seen.hits.depth.reshape(clean.shape[:2]))
        for kind, view in (("camdata_left", now.view), ("camdata_right", now_right.view)):
            _write_view(folders[kind] / f"{stem}.cam", view)
        if scene.camera.distortion is not None:
            write_json(folders[LENS] / f"{stem}.json", scene.camera.distortion.model_dump())
        _write_motion(folders, stem, moved, clean.shape[:2], last=frame == scene.frames - 1)


def kinds_of(scene: Scene) -> list[str]:
    """The folders of frames and truth that a scene gets."""
    return [*KINDS, *([] if scene.camera.distortion is None else [LENS])]


def explanation(scene: Scene, name: str, seed: int, watch: Stopwatch) -> dict[str, object]:
    """The manifest: the scene, the effects that were simulated and those that were not, and the seconds of each."""
    listed = scene.effects.listed
    return {
        "scene": name,
        "description": scene.description,
        "split": scene.split or "own",
        "seed": seed,
        "frames": scene.frames,
        "width": scene.width,
        "height": scene.height,
        "objects": {shape.name: shape.kind for shape in scene.objects},
        "distortion": scene.camera.distortion and scene.camera.distortion.model_dump(),
        "effects": {effect: getattr(scene.effects, effect).model_dump() for effect in listed},
        "not_simulated": [effect for effect in Effects.model_fields if effect not in listed],
        "seconds": {key: round(value, 4) for key, value in watch.spent.items()},
        "calls": watch.calls,
    }


def explain(content: dict[str, object]) -> str:
    """The manifest as a readable table."""
    seconds, calls, effects = content["seconds"], content["calls"], content["effects"]
    assert isinstance(seconds, dict)
    assert isinstance(calls, dict)
    assert isinstance(effects, dict)
    rows = [f"{content['scene']}: {content['description']}", f"{'':16}{'seconds':>9}{'calls':>7}"]
    rows += [f"{key:16}{seconds[key]:9.3f}{calls[key]:7d}  {effects.get(key, '')}" for key in seconds]
    absent = content["not_simulated"]
    assert isinstance(absent, list)
    return "\n".join([*rows, f"not simulated: {', '.join(absent) or 'nothing'}"])


def _write_view(path: Path, view: View) -> None:
    sintel.write_cam(path, view.K, view.cam_from_world[:3])


def _write_motion(folders: dict[str, Path], stem: str, moved: Motion, shape: tuple[int, int], last: bool) -> None:
    for kind, mask in (("motion_mask", moved.moving), ("mover_mask", moved.mover)):
        write_image(folders[kind] / f"{stem}.png", mask.reshape(shape))
    if last:
        return
    sintel.write_flo(folders["flow"] / f"{stem}.flo", np.reshape(moved.flow, (*shape, 2)))
    for kind, mask in (("occlusions", moved.occluded), ("invalid", moved.invalid)):
        write_image(folders[kind] / f"{stem}.png", mask.reshape(shape))


if __name__ == "__main__":
    cli.run(main)
