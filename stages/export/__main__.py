"""Export a finished sequence to the formats of other programs."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from stages.export.options import ExportOptions
from stages.shared import cli
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.image_headers import is_shown_as_stored
from stages.shared.images import read_rgb, write_image
from stages.shared.log import logger, progress

if TYPE_CHECKING:
    from stages.export.clip import Clip
    from stages.export.points import Points

FILES = (
    *("images/*", "sparse/0/*.bin", "sparse_text/*.txt", "original/*.txt"),
    *("transforms.json", "points3D.ply", "scene.npz"),
    *("depth/frame_*.png", "depth/scale.json", "masks/*.png", "splats/frame_*.ply", "splats/frame_*.spz", "video.mp4"),
)


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    masks: Annotated[Path, In("folder of dynamic masks")],
    depth: Annotated[Path, In("ba/depth.arrow")],
    output: Annotated[Path, Out("folder of what is asked for")],
    options: ExportOptions,
    model: Annotated[Path | None, In("gaussians/model.safetensors, for ply and spz")] = None,
    renders: Annotated[Path | None, In("folder of renders, for the video")] = None,
    lens: Annotated[Path | None, In("lens/lens.json, for the cameras of the original frames")] = None,
) -> str:
    """Write what other programs read, in the conventions of docs/conventions.md; what is not asked for is not computed.

    colmap: images/, sparse/0 (binary), sparse_text, and original/ if frames were undistorted; nerfstudio: images/,
    transforms.json and points3D.ply; npz: scene.npz, everything in our conventions; depth_png: depth/; masks: masks/ in
    COLMAP's naming; ply, spz: splats/; video: video.mp4. Frames whose pose was not estimated are left out of the first
    two; masks alone need no poses.
    """
    from stages.export.clip import read_clip
    from stages.shared.atomic import atomic_folder

    _require(options.writes("ply", "spz"), model, "--model", "gaussians/model.safetensors")
    _require(options.writes("video"), renders, "--renders", "the folder renders/")
    clip = read_clip(sequence, poses, masks, depth, needs_poses=set(options.formats) != {"masks"})
    with atomic_folder(output, FILES) as folder:
        _write_cameras(folder, clip, options)
        if lens and options.writes("colmap"):
            _write_original(folder / "original", clip, lens)
        _write_images(folder, clip, options)
        if model and options.writes("ply", "spz"):
            _write_splats(folder / "splats", clip, model, options)
        if renders and options.writes("video"):
            _write_video(folder / "video.mp4", renders, clip.content.times_s)
    return f"{', '.join(dict.fromkeys(options.formats))}: {int(clip.posed.sum())} of {len(clip.posed)} cameras"


def _require(needed: bool, path: Path | None, flag: str, what: str) -> None:
    if needed and path is None:
        raise InputError(flag, what, "nothing", "give it, or leave out the formats that need it")


def _write_cameras(folder: Path, clip: "Clip", options: ExportOptions) -> None:
    """COLMAP's model, transforms.json with the frames, and the archive: what needs cameras and points."""
    from stages.export.points import find_points

    if not options.writes("colmap", "nerfstudio", "npz"):
        return
    points = find_points(clip.grid())
    logger.info("%d points in %d observations", len(points.xyz), len(points.uv))
    if options.writes("colmap", "nerfstudio"):
        (folder / "images").mkdir()
        for _, frame in clip.posed_frames():
            _write_frame(frame, folder / "images" / frame.name)
    if options.writes("colmap"):
        _write_colmap(folder, clip, points)
    if options.writes("nerfstudio"):
        _write_nerfstudio(folder, clip, points, options)
    if options.writes("npz"):
        from stages.export.everything import write_everything

        write_everything(folder / "scene.npz", clip, points)


def _write_frame(frame: Path, target: Path) -> None:
    """The frame as the cameras see it: a copy of the file, unless that is one that a reader may turn or not."""
    if is_shown_as_stored(frame):
        shutil.copyfile(frame, target)
    else:
        write_image(target, read_rgb(frame))


def _write_colmap(folder: Path, clip: "Clip", points: "Points") -> None:
    from stages.export.colmap_model import Model, write_binary, write_text

    names = [frame.name for _, frame in clip.posed_frames()]
    size, cameras = (clip.content.width, clip.content.height), clip.cameras
    model = Model(names, *size, cameras.cam_from_world[clip.posed], cameras.Ks[clip.posed], points)
    for name, write in {"sparse/0": write_binary, "sparse_text": write_text}.items():
        (folder / name).mkdir(parents=True)
        write(folder / name, model)


def _write_original(folder: Path, clip: "Clip", lens: Path) -> None:
    """The same poses for the frames before they were undistorted; nothing if they were not."""
    from stages.export.colmap_model import write_distorted
    from stages.shared.artifacts import read_json

    about = read_json(lens)
    if about["coefficients_px"] is None:
        return
    original, cameras = about["original"], clip.cameras
    names = [Path(original["frames"][k]).name for k, _ in clip.posed_frames()]
    Ks = cameras.Ks[clip.posed]
    Ks[:, :2, 2] += about["left"], about["top"]
    folder.mkdir()
    size = original["width"], original["height"]
    write_distorted(folder, names, size, cameras.cam_from_world[clip.posed], Ks, about["coefficients_px"])


def _write_nerfstudio(folder: Path, clip: "Clip", points: "Points", options: ExportOptions) -> None:
    import json

    from stages.export.images import depth_path
    from stages.export.transforms import transforms, write_points
    from stages.shared.split import frame_times

    times, files = frame_times(len(clip.posed)), []
    for k, frame in clip.posed_frames():
        files.append({"file_path": f"images/{frame.name}", "time": float(times[k])})
        if options.writes("masks"):
            files[-1]["mask_path"] = f"masks/{frame.name}.png"
        if options.writes("depth_png"):
            files[-1]["depth_file_path"] = depth_path(Path("depth"), clip.content.numbers[k]).as_posix()
    size, cameras = (clip.content.width, clip.content.height), clip.cameras
    content = transforms(files, *size, cameras.cam_from_world[clip.posed], cameras.Ks[clip.posed])
    if len(points.xyz):
        write_points(folder / "points3D.ply", points.xyz, points.rgb)
        content["ply_file_path"] = "points3D.ply"
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n")


def _write_images(folder: Path, clip: "Clip", options: ExportOptions) -> None:
    from stages.export.images import write_depths, write_masks

    writers: dict[str, Callable[[Path, Clip], None]] = {"depth_png": write_depths, "masks": write_masks}
    for name, write in writers.items():
        if name in options.formats:
            target = folder / name.removesuffix("_png")
            target.mkdir()
            write(target, clip)


def _write_splats(folder: Path, clip: "Clip", model: Path, options: ExportOptions) -> None:
    """The Gaussians of every frame that is asked for, moved to its time."""
    from stages.shared.split import frame_times
    from stages.splatting.model_files import read_scene, write_splats

    scene, times = read_scene(model), frame_times(len(clip.posed))
    chosen = [k for k, number in enumerate(clip.content.numbers) if options.writes_splats_of(number)]
    if options.splat_frames != "all" and (unknown := sorted(set(options.splat_frames) - set(clip.content.numbers))):
        logger.warning("export: no splats of frames %s of `splat_frames`: there are no such numbers", unknown)
    folder.mkdir()
    for k in progress(chosen, "splats"):
        for suffix in ("ply", "spz"):
            if suffix in options.formats:
                write_splats(folder / f"frame_{clip.content.numbers[k]:04d}.{suffix}", scene, float(times[k]))


def _write_video(path: Path, renders: Path, times_s: list[float] | None) -> None:
    from stages.export.images import CODECS, write_video

    codec = write_video(path, renders, times_s)
    logger.info("video.mp4: codec %s", codec)
    if codec != CODECS[0]:
        logger.warning("export: video.mp4 has the codec %s, which most browsers do not play", codec)


if __name__ == "__main__":
    cli.run(main)
