"""The frames of a video file with their time stamps, one at a time, through FFmpeg's libraries (PyAV)."""

import contextlib
import itertools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from stages.shared.errors import InputError
from stages.shared.images import reduce, reduced_size
from stages.video.orientation import as_shown, display_matrix, swaps_sides

HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
"""Transfer functions of HDR video by their number in ITU-T H.273."""
SHORTER = 0.1
"""A video that ends before this share of its declared length (and two frames) is incomplete: containers round lengths,
and count the last frame in or out."""


@dataclass(frozen=True)
class Header:
    """What a file says about its video.

    Attributes:
        length_s: declared length, None if there is none. frames: declared number, 0 if there is none.
        start_pts: time stamp of the first frame, in `time_base` seconds. aspect: width of a pixel over its height.
    """

    codec: str
    frames: int
    length_s: float | None
    rate_hz: float | None
    start_pts: int
    time_base: Fraction
    aspect: float


@dataclass(frozen=True, eq=False)
class Frame:
    """A decoded frame.

    Attributes:
        pts: its time stamp in the file. time_s: seconds since the first frame of the video.
        interlaced: whether it was deinterlaced. image: the decoder's picture, neither rotated nor reduced.
    """

    pts: int
    time_s: float
    interlaced: bool
    image: av.VideoFrame


def read_header(path: Path) -> Header:
    """What the file says about its video; no frame is decoded.

    Raises:
        InputError: for a file that is empty, is no video, or has sound alone.
    """
    with _opened(path) as (container, stream):
        only = len(container.streams) == 1
        time_base = stream.time_base or Fraction(1, av.time_base)
        length = stream.duration * time_base if stream.duration else None
        if length is None and only and container.duration:
            # Matroska's counts from time 0, others' from the first time stamp.
            start = container.start_time or 0 if "matroska" in container.format.name else 0
            length = Fraction(container.duration - start, av.time_base)
        aspect = stream.sample_aspect_ratio or 1
        return Header(
            codec=stream.codec_context.codec.name,
            frames=stream.frames,
            length_s=float(length) if length else None,
            rate_hz=float(stream.average_rate) if stream.average_rate else None,
            start_pts=stream.start_time or 0,
            time_base=time_base,
            aspect=float(aspect),
        )


def read_frames(
    path: Path, start_s: float = 0, end_s: float | None = None, unordered: list[Fraction | None] | None = None
) -> Iterator[Frame]:
    """The frames from `start_s` to `end_s` (seconds since the first frame, both included), in the order of their times.

    Interlaced ones are deinterlaced: their first field is kept, the other one interpolated (bwdif). Frames without a
    time stamp, or with one that is not after that of the frame before, are left out.

    Args:
        unordered: takes the times (s, or None) of the frames that are left out for their time stamps.

    Raises:
        InputError: for a file that is no video, or a frame that cannot be decoded.
    """
    header, last_s = read_header(path), Fraction(-1)
    with _opened(path) as (container, stream):
        stream.codec_context.thread_type = "AUTO"
        stream.codec_context.thread_count = int(os.environ["OMP_NUM_THREADS"])
        if start_s > 0:
            _seek(container, stream, header, start_s)
        frames = _decoded(container, stream, path, header)
        for image, interlaced in _deinterlaced(frames, stream):
            time_s = _time_s(image, header)
            if time_s is None or time_s <= last_s:
                if unordered is not None:
                    unordered.append(time_s)
                continue
            if float(time_s) < start_s:
                continue
            last_s, seconds = time_s, float(time_s)
            if end_s is None or seconds <= end_s:
                yield Frame(header.start_pts + round(time_s / header.time_base), seconds, interlaced, image)
            if end_s is not None and seconds >= end_s:
                return  # without a look at the next frame, which may be broken


def is_cut_short(header: Header, last_s: float, interval_s: float) -> bool:
    """Whether the video ends, with a last frame at `last_s`, well before its declared length.

    Args:
        interval_s: between the frames before.
    """
    missing = (header.length_s or 0) - last_s - interval_s
    return missing > 2 * interval_s and missing > SHORTER * (header.length_s or 0)


def end_option(last_s: float) -> str:
    """The option, as it is written, by which no frame of a video is read after that at `last_s`.

    Rounded to the next millisecond it would ask for the frame after that one; so it may leave that one out.
    """
    return f"`video: {{end: {math.floor(1000 * last_s + 1e-6) / 1000:.3f}}}`"


def upright(frame: Frame, header: Header, bars_px: tuple[int, int], max_side: int) -> np.ndarray:
    """A frame [H, W, 3] uint8 RGB with square pixels, as a player shows it, its longer side at most `max_side` px.

    10-bit values are rounded. Colours of HDR videos stay as they are coded.

    Args:
        bars_px: what is cut off left and right, and above and below, of the frame as coded.
    """
    (x, y), coded = bars_px, frame.image.reformat(format="rgb24").to_ndarray()
    pixels = coded[y : len(coded) - y, x : coded.shape[1] - x]
    size = _square(pixels.shape[1], pixels.shape[0], header.aspect)
    pixels = pixels if size == pixels.shape[1::-1] else cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC)
    shown = np.ascontiguousarray(as_shown(pixels, display_matrix(frame.image)))
    return reduce(shown, reduced_size(shown.shape[1], shown.shape[0], max_side))


def upright_size(frame: Frame, header: Header, bars_px: tuple[int, int], max_side: int) -> tuple[int, int]:
    """Width and height of the `upright` frame, px."""
    x, y = bars_px
    width, height = _square(frame.image.width - 2 * x, frame.image.height - 2 * y, header.aspect)
    if swaps_sides(display_matrix(frame.image)):
        width, height = height, width
    return reduced_size(width, height, max_side)


def grey(frame: Frame) -> np.ndarray:
    """The brightness of a frame, [H, W] uint8, as coded: neither rotated nor with square pixels."""
    return frame.image.reformat(format="gray").to_ndarray()


def _square(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The size at which pixels are square; the side that is too short is enlarged."""
    return (round(width * aspect), height) if aspect >= 1 else (width, round(height / aspect))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    advice = "give a video that a player plays, or a folder of frames"
    if path.stat().st_size == 0:
        raise InputError(path, "a video", "an empty file", "copy or export the video again")
    try:
        container = av.open(str(path), "r")
    except (av.FFmpegError, ValueError) as error:
        found = f"a file that cannot be opened as one ({_reason(error)})"
        raise InputError(path, "a video", found, "copy or export it again, " + advice) from error
    with container:
        if container.format.name == "tty":  # FFmpeg draws .txt files as terminals did
            raise InputError(path, "a video", "a text", advice)
        pictures = av.stream.Disposition.attached_pic
        videos = [stream for stream in container.streams.video if not stream.disposition & pictures]
        if not videos:
            found = "sound alone" if container.streams.audio else "no stream of pictures"
            raise InputError(path, "a video", found, advice)
        yield container, videos[0]


def _seek(container: av.container.InputContainer, stream: av.VideoStream, header: Header, start_s: float) -> None:
    """Go to the last key frame before a time, or to the beginning where the file cannot do that."""
    wanted = header.start_pts + int(start_s / header.time_base)
    try:
        container.seek(wanted, stream=stream)
        first = next(container.demux(stream)).pts  # some formats land after the wanted time
        container.seek(wanted if first is not None and first <= wanted else header.start_pts, stream=stream)
    except (av.FFmpegError, StopIteration):
        with contextlib.suppress(av.FFmpegError):
            container.seek(header.start_pts, stream=stream)


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream, path: Path, header: Header
) -> Iterator[av.VideoFrame]:
    last_s = Fraction(0)
    try:
        for frame in container.decode(stream):
            last_s = _time_s(frame, header) or last_s
            yield frame
    except av.FFmpegError as error:
        found = f"one that cannot be decoded after {float(last_s):.3f} s ({_reason(error)})"
        advice = f"copy or export the video again, or use the part before by {end_option(float(last_s))}"
        raise InputError(path, "a complete video", found, advice) from error


def _time_s(image: av.VideoFrame, header: Header) -> Fraction | None:
    """Time of a frame since the first one, exact; None if it has no time stamp."""
    if image.pts is None or image.time_base is None:
        return None
    return image.pts * image.time_base - header.start_pts * header.time_base


def _deinterlaced(frames: Iterator[av.VideoFrame], stream: av.VideoStream) -> Iterator[tuple[av.VideoFrame, bool]]:
    """Every frame, deinterlaced if it is marked as interlaced, and whether it, or one before it, was."""
    for first in frames:
        if first.interlaced_frame:
            frames = itertools.chain([first], frames)
            break
        yield first, False
    else:
        return
    graph = av.filter.Graph()
    graph.link_nodes(
        graph.add_buffer(template=stream),
        graph.add("bwdif", "mode=send_frame:deint=interlaced"),
        graph.add("buffersink"),
    ).configure()
    for frame in itertools.chain(frames, [None]):
        graph.vpush(frame)
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                yield graph.vpull(), True


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).splitlines()[0]
