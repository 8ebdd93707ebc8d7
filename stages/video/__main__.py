"""Decode one shot of a video into a folder of frames, with their time stamps and what was found about the video."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from stages.shared import cli
from stages.shared.cli import In, Out
from stages.video.options import VideoOptions

if TYPE_CHECKING:
    from stages.video.shots import Shot


class DecodeOptions(VideoOptions):
    """Options of this script; those that choose the shot are flags only."""

    shot: int = Field(1, ge=1, description="which shot of the video, by its number, if cuts divide it")
    cuts: bool = Field(True, description="look for cuts; else the video is one shot")
    first: int | None = Field(None, ge=1, description="number of the first frame, of a part of the shot")
    last: int | None = Field(None, ge=1, description="number of the last frame of that part")


def main(
    video: Annotated[Path, In("video file")],
    output: Annotated[Path, Out("folder of frames, frame_0001.png, ...")],
    findings: Annotated[Path, Out("JSON: time stamps of the frames, and what was found about the video")],
    options: DecodeOptions,
    indexes: Annotated[Path | None, In("folder of the indexes that the workflow made when it looked for cuts")] = None,
) -> str:
    """Write the frames of one shot upright, with square pixels, and without those that repeat others."""
    from stages.shared.artifacts import write_json
    from stages.shared.errors import InputError
    from stages.shared.log import logger
    from stages.video.index import load_index
    from stages.video.shots import cut_out

    looked = VideoOptions(**options.model_dump(include=set(VideoOptions.model_fields)))
    index = load_index(video, looked, indexes, options.cuts)
    if options.shot > len(index.shots):
        raise InputError(video, f"a shot {options.shot}", f"{len(index.shots)}", "choose another --shot")
    shot, name = list(index.shots.values())[options.shot - 1], output.name
    if options.first is not None and options.last is not None:
        shot = cut_out(shot, options.first, options.last)
    for warning in index.warnings:
        logger.info("%s: %s", video, warning)  # `inspect` warns of them
    _write_frames(video, shot, index.bars_px, options.max_side, output)
    write_json(
        findings,
        {
            "name": name,
            "clip": {"name": video.stem, "left_out": ""},
            "times_s": shot.times_s,
            "warnings": index.warnings,
        }
        | index.findings
        | {"bars_px": index.bars_px},
    )
    size, (first_s, last_s) = f"{index.width} x {index.height} px", (shot.times_s[0], shot.times_s[-1])
    return f"{len(set(shot.pts))} frames of {size}, {first_s:.2f} to {last_s:.2f} s"


def _write_frames(video: Path, shot: "Shot", bars_px: tuple[int, int], max_side: int, output: Path) -> None:
    """Write the frames of a shot, cut to the picture inside of its bars, into the folder `output`, all or none."""
    from stages.shared.atomic import atomic_folder
    from stages.shared.errors import InputError
    from stages.shared.images import write_image
    from stages.shared.log import progress
    from stages.video import decode

    header, wanted, number = decode.read_header(video), set(shot.pts), 0
    with atomic_folder(output, ["frame_*.png"]) as folder:
        frames = decode.read_frames(video, shot.times_s[0], shot.times_s[-1])
        used = (frame for frame in frames if frame.pts in wanted)
        for number, frame in enumerate(progress(used, output.name, len(wanted)), start=1):
            path = folder / f"frame_{shot.first + number - 1:04d}.png"
            write_image(path, decode.upright(frame, header, bars_px, max_side))
        if number != len(wanted):
            advice = "the file has changed since it was indexed: run again"
            raise InputError(video, f"{len(wanted)} frames", f"{number}", advice)


if __name__ == "__main__":
    cli.run(main)
