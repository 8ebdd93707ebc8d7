"""The values of `intrinsics:`: where the cameras' intrinsics come from, in the words of a config file."""

import re
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator, WithJsonSchema

ESTIMATE, TRUTH, EXIF = "estimate", "truth", "exif"
SUFFIXES = (".txt", ".bin")
"""Of COLMAP's cameras files."""
KEYS = {"mm": ("focal_mm", "sensor_width_mm"), "lens": ("fx", "fy", "cx", "cy")}
"""Names of the numbers where they are a mapping."""
EXPECTED = (
    "estimate, truth, exif, a focal length as in '1200 px' or '26 mm / 36 mm' (focal length / sensor width), "
    "[fx, fy, cx, cy] in px, or a COLMAP cameras.txt"
)
NUMBER = r"\s*([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*"
FORMS = {
    "px": rf"{NUMBER}(?:px)?\s*",
    "mm": rf"{NUMBER}mm\s*/{NUMBER}mm\s*",
    "lens": rf"{','.join([NUMBER] * 4)}(?:px)?\s*",
}
"""How numbers are written, by kind."""


class Intrinsics(NamedTuple):
    """A value of `intrinsics:`.

    `kind` is "estimate", "truth", "exif", "px" (a focal length), "mm" (a focal length, the sensor's width), "lens" (fx,
    fy, cx, cy, px) or "file"; `numbers` are those of the kinds in brackets, `path` is the file.
    """

    kind: str
    numbers: tuple[float, ...] = ()
    path: str = ""


def parse(text: str) -> Intrinsics:
    """The meaning of a value as `in_one_line` writes it.

    Raises:
        ValueError: says what was expected.
    """
    if text in (ESTIMATE, TRUTH, EXIF):
        return Intrinsics(text)
    for kind, form in FORMS.items():
        if found := re.fullmatch(form, text):
            numbers = tuple(map(float, found.groups()))
            if min(numbers[:2]) <= 0:
                raise ValueError("focal lengths and sensor widths above 0")
            return Intrinsics(kind, numbers)
    if text.lower().endswith(SUFFIXES):
        return Intrinsics("file", path=text)
    raise ValueError(EXPECTED)


def in_one_line(value: Any) -> str:
    """A value of `intrinsics:` as text: a number, a list fx fy cx cy and mappings are written as `parse` reads them.

    Raises:
        ValueError: says what was expected.
    """
    if isinstance(value, Mapping):
        kinds = [kind for kind, keys in KEYS.items() if set(keys) == set(value)]
        if not kinds:
            raise ValueError(" or ".join(f"{{{', '.join(keys)}}}" for keys in KEYS.values()))
        numbers = [str(value[key]) for key in KEYS[kinds[0]]]
        value = f"{numbers[0]} mm / {numbers[1]} mm" if kinds[0] == "mm" else ", ".join(numbers)
    elif isinstance(value, (list, tuple)):
        value = ", ".join(map(str, value))
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(EXPECTED)
    text = str(value).strip()
    parse(text)
    return text


SCHEMA = {
    "anyOf": [
        {"type": "string"},
        {"type": "number", "exclusiveMinimum": 0},
        {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
        *(
            {
                "type": "object",
                "properties": {key: {"type": "number"} for key in keys},
                "required": list(keys),
                "additionalProperties": False,
            }
            for keys in KEYS.values()
        ),
    ]
}
IntrinsicsOption = Annotated[str, BeforeValidator(in_one_line), WithJsonSchema(SCHEMA)]
"""The type of the option."""
