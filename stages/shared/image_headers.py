"""Size and kind of an image file from its header and last bytes, without decoding."""

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from stages.shared.errors import InputError

WIDEST = 8
"""Frames are at most so many times as wide as high: reduced for the flow, a strip has too few rows to search in."""
END_OF_PNG, END_OF_JPEG, SCAN_OF_JPEG = b"IEND\xaeB`\x82", b"\xff\xd9", b"\xff\xda"
TAIL = 64
"""Bytes among which a file ends, unless a camera has put something behind the picture."""
PNG_DEPTH_AT = 24
"""Byte of a PNG file with the bits of a channel, which Pillow does not tell of colours."""
ORIENTATION = 0x0112
"""EXIF tag; from 5 on the picture is shown with rows for columns."""


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height), as it is shown, and kind of an image file: Pillow's mode, with ";16" for 16-bit colours.

    Raises:
        InputError: if the file is neither a PNG nor a JPEG image, or is truncated.
    """
    try:
        with Image.open(path) as image:
            size, kind, is_png, is_jpeg = image.size, image.mode, image.format == "PNG", image.format in ("JPEG", "MPO")
            turned = is_jpeg and image.getexif().get(ORIENTATION, 1) >= 5
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(
            path, "a PNG or JPEG image", "something else or a broken header", "replace the file"
        ) from error
    if not is_png and not is_jpeg:
        raise InputError(path, "a PNG or JPEG image", f"one of the format {image.format}", "convert the frames")
    if not (_png_is_complete(path) if is_png else _jpeg_is_complete(path)):
        raise InputError(path, "a complete image", "one that ends too early", "copy or export the file again")
    deep = is_png and kind in ("RGB", "RGBA", "LA") and _first_bytes(path, PNG_DEPTH_AT + 1)[PNG_DEPTH_AT] == 16
    return (size[::-1] if turned else size), kind + ";16" * deep


def refuse_strip(path: Path, width: int, height: int) -> None:
    """Refuse frames, or a video, more than WIDEST times as wide as high.

    Raises:
        InputError: names the file.
    """
    if width > WIDEST * height:
        expected = f"frames at most {WIDEST} times as wide as high"
        raise InputError(path, expected, f"{width} x {height}", "crop their sides")


def conversions(kinds: set[str]) -> list[str]:
    """What reading images of these kinds (`read_header`) as 8-bit RGB changes, as sentences."""
    grey, deep = "grey frames are used as RGB", "16-bit frames are reduced to 8 bits"
    told = {
        "L": f"{grey} with equal channels",
        "1": "black-and-white frames are used as RGB with equal channels",
        "I;16": deep,
        "I": deep,
        "RGB;16": deep,
        "RGBA": "the alpha channel is dropped",
        "RGBA;16": f"{deep}; the alpha channel is dropped",
        "LA": f"{grey}; the alpha channel is dropped",
        "LA;16": f"{deep}; the alpha channel is dropped",
        "P": "palette frames are expanded to RGB",
    }
    return sorted({told[kind] for kind in kinds if kind in told})


def _png_is_complete(path: Path) -> bool:
    return END_OF_PNG in _last_bytes(path)


def _jpeg_is_complete(path: Path) -> bool:
    """Whether the picture ends: at the end of the file, or before what the camera has put behind it, as phones do.

    Before the picture the end of a thumbnail may stand; in its data the mark of the end is not found.
    """
    if END_OF_JPEG in _last_bytes(path):
        return True
    content = path.read_bytes()
    return content.find(END_OF_JPEG, max(content.find(SCAN_OF_JPEG, _after_thumbnail(content)), 0)) >= 0


def _after_thumbnail(content: bytes) -> int:
    """Where in a JPEG file the segments with metadata (APP0 to APP15) end."""
    at = 2
    while content[at : at + 1] == b"\xff" and 0xE0 <= content[at + 1] <= 0xEF:
        at += 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return at


def _first_bytes(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


def _last_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(-min(TAIL, path.stat().st_size), 2)
        return file.read()
