"""Size and kind of an image file from its header and last bytes, without decoding."""

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from stages.shared.errors import InputError


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height) and Pillow mode of an image file.

    Raises:
        InputError: if the file is not an image or is truncated.
    """
    try:
        with Image.open(path) as image:
            size, mode = image.size, image.mode
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(
            path, "a PNG or JPEG image", "something else or a broken header", "replace the file"
        ) from error
    end = b"IEND\xaeB`\x82" if path.suffix.lower() == ".png" else b"\xff\xd9"
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), 2)
        if end not in file.read():
            raise InputError(path, "a complete image", "one that ends too early", "copy or export the file again")
    return size, mode


def conversions(modes: set[str]) -> list[str]:
    """What reading images of these Pillow modes as 8-bit RGB changes, as sentences."""
    told = {
        "L": "grey frames are used as RGB with equal channels",
        "1": "black-and-white frames are used as RGB with equal channels",
        "I;16": "16-bit frames are reduced to 8 bits",
        "I": "16-bit frames are reduced to 8 bits",
        "RGBA": "the alpha channel is dropped",
        "LA": "grey frames are used as RGB; the alpha channel is dropped",
        "P": "palette frames are expanded to RGB",
    }
    return sorted(told[mode] for mode in modes if mode in told)
