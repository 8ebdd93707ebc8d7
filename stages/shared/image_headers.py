"""Size and kind of an image file from its header and last bytes, without decoding."""

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from stages.shared.errors import InputError

LONGEST = 8
"""One side of a frame is at most so many times the other: reduced for the flow, a strip is too narrow to search in."""
JPEGS = ("JPEG", "MPO")
"""Pillow's names of the format, with one picture and with several."""
END_OF_PNG, END_OF_JPEG = b"IEND\xaeB`\x82", b"\xff\xd9"
SCAN_OF_JPEG = 0xDA
"""Marker of the segment that the data of the picture follow."""
TAIL = 64
"""Bytes among which a file ends, unless a camera has put something behind the picture."""
PNG_DEPTH_AT = 24
"""Byte of a PNG file with the bits of a channel, which Pillow does not tell of colours."""
ORIENTATION, AS_STORED, TRANSPOSED = 0x0112, 1, (5, 6, 7, 8)
"""EXIF tag: how a picture is shown; its values for one as it is stored, and with rows for columns."""


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height), as it is shown, and kind of an image file: Pillow's mode, with ";16" for 16-bit colours.

    Raises:
        InputError: if the file is neither a PNG nor a JPEG image, or is truncated.
    """
    try:
        with Image.open(path) as image:
            size, kind, is_png, is_jpeg = image.size, image.mode, image.format == "PNG", image.format in JPEGS
            turned = is_jpeg and _orientation(image) in TRANSPOSED
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


def is_shown_as_stored(path: Path) -> bool:
    """Whether an image file is no JPEG that its EXIF data ask to turn or to mirror."""
    with Image.open(path) as image:
        return image.format not in JPEGS or _orientation(image) == AS_STORED


def refuse_strip(path: Path, width: int, height: int) -> None:
    """Refuse frames, or a video, of which one side is more than LONGEST times as long as the other.

    Raises:
        InputError: names the file.
    """
    if max(width, height) > LONGEST * min(width, height):
        expected = f"frames whose longer side is at most {LONGEST} times the shorter one"
        raise InputError(path, expected, f"{width} x {height}", "crop their longer side")


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

    Segments before it are passed over, where the end of a thumbnail may stand; in its data that mark is not found.
    """
    if END_OF_JPEG in _last_bytes(path):
        return True
    content, at = path.read_bytes(), 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        if content[at + 1] == SCAN_OF_JPEG:
            return content.find(END_OF_JPEG, at) >= 0
        is_padding = content[at + 1] == 0xFF
        at += 1 if is_padding else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return False


def _orientation(image: Image.Image) -> int:
    """How a JPEG is to be shown, 1 to 8; other metadata than EXIF, of which OpenCV knows nothing, do not count."""
    image.info.pop("xmp", None)
    return int(image.getexif().get(ORIENTATION, AS_STORED))


def _first_bytes(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


def _last_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(-min(TAIL, path.stat().st_size), 2)
        return file.read()
