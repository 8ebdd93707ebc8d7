"""The page of the viewer: one HTML file that holds script, style, shaders, model and input frames."""

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import jinja2
import markupsafe
import numpy as np

from stages.viewer.packing import to_blob

TEMPLATES = Path(__file__).parent / "templates"
SCRIPTS = ("model.js", "order.js", "gl.js", "splats.js", "lines.js", "view.js", "input.js", "panel.js", "main.js")
"""In this order they are one script: each uses what those before it define."""
SHADERS = ("project.vert", "splat.vert", "splat.frag", "resolve.vert", "resolve.frag", "line.vert", "line.frag")
PICTURE_WIDTH_PX = 640
PICTURE_BUDGET_BYTES = 1_200_000
"""Of all input frames together, before base64."""
MOST_PICTURES = 200
"""Of longer clips so many input frames are shown, evenly spread."""
QUALITIES = ((70, 1.0), (50, 1.0), (35, 1.0), (35, 0.7), (25, 0.5), (15, 0.35))
"""WebP quality and share of the width, tried in this order until the frames are within their budget."""


def render_page(
    name: str,
    arrays: Mapping[str, np.ndarray],
    numbers: Mapping[str, Any],
    size: tuple[int, int],
    pictures: list[bytes],
) -> str:
    """The page as HTML.

    Args:
        name: of the sequence. arrays, numbers: of `packing.pack_scene`. size: (width, height) of a frame in px.
        pictures: of input frames, evenly spread over all, as `encoded` makes them; empty: no comparison with the input.
    """
    blob, layout = to_blob(arrays)
    scene = {**numbers, "name": name, "width": size[0], "height": size[1], "arrays": layout}
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("scene.html.j2").render(
        name=name,
        scene=_inline(json.dumps(scene, separators=(",", ":"))),
        blob=markupsafe.Markup(blob),
        pictures=_inline(json.dumps([data_uri(picture) for picture in pictures])),
        style=markupsafe.Markup((TEMPLATES / "style.css").read_text()),
        script=markupsafe.Markup("\n".join((TEMPLATES / file).read_text() for file in SCRIPTS)),
        shaders={file: markupsafe.Markup((TEMPLATES / file).read_text()) for file in SHADERS},
    )


def _inline(text: str) -> markupsafe.Markup:
    """JSON for a script element, which the text `</script>` in a name would end."""
    return markupsafe.Markup(text.replace("<", "\\u003c"))


def data_uri(picture: bytes) -> str:
    """Data URI of a WebP."""
    return f"data:image/webp;base64,{b64encode(picture).decode()}"


def encoded(images: Iterable[np.ndarray]) -> list[bytes]:
    """Frames [H, W, 3] uint8 RGB as WebP of at most PICTURE_WIDTH_PX; if possible PICTURE_BUDGET_BYTES in all."""
    reduced = [_reduced(image, PICTURE_WIDTH_PX / image.shape[1]) for image in images]
    for quality, share in QUALITIES:
        pictures = [_webp(_reduced(image, share), quality) for image in reduced]
        if sum(map(len, pictures)) <= PICTURE_BUDGET_BYTES:
            break
    return pictures


def _reduced(image: np.ndarray, factor: float) -> np.ndarray:
    height, width = image.shape[:2]
    size = max(1, round(factor * width)), max(1, round(factor * height))
    return image if factor >= 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _webp(image: np.ndarray, quality: int) -> bytes:
    return bytes(cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[1])
