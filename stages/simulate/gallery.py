"""The contact sheet of the scene library: one image per scene."""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from stages.shared import cli
from stages.shared.cli import In, Out
from stages.shared.drawing import contact_sheet
from stages.shared.images import write_image
from stages.shared.log import progress
from stages.shared.options import Options
from stages.simulate import frames
from stages.simulate.scene import load_scene


class GalleryOptions(Options):
    """The contact sheet."""

    columns: int = Field(3, ge=1, le=8, description="scenes per row")
    width_px: int = Field(1140, ge=200, le=4000, description="width of the sheet")
    seed: int = Field(0, ge=0, description="seed of camera noise, textures and placement")


def main(
    scenes: Annotated[Path, In("folder of scene files")],
    output: Annotated[Path, Out("contact sheet, e.g. docs/scenes.jpg")],
    options: GalleryOptions,
) -> None:
    """Render the final pass of the middle frame of every scene, with its name, split and description."""
    cells = [_cell(path, options.seed) for path in progress(sorted(scenes.glob("*.yaml")), "scenes")]
    write_image(output, contact_sheet(cells, options.columns, options.width_px))


def _cell(path: Path, seed: int) -> np.ndarray:
    """An image of a scene, 512 px wide, above its caption."""
    scene = load_scene(path)
    scene = scene.model_copy(update={"height": round(scene.height * 512 / scene.width), "width": 512})
    stage, middle = frames.set_stage(scene, seed), scene.frames // 2
    now = stage.moment(middle)
    seen = frames.see(stage, now)
    clean = frames.develop(stage, now, seen, with_effects=False)
    final = frames.to_srgb(frames.final(stage, middle, now, seen, clean))
    caption = np.full((34, 512, 3), 255, np.uint8)
    name = f"{path.stem} ({scene.split})" if scene.split else path.stem
    cv2.putText(caption, name, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(caption, scene.description, (4, 29), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (90, 90, 90), 1, cv2.LINE_AA)
    return np.concatenate([final, caption])


if __name__ == "__main__":
    cli.run(main)
