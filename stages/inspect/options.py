"""Options of the input check."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from stages.shared.options import Options
from stages.shared.sequences import MIN_FRAMES


class InspectOptions(Options):
    """Which frames are used, and what is burnt into them."""

    max_frames: Literal["all"] | Annotated[int, Field(ge=MIN_FRAMES)] = Field(
        "all", description="number of frames to use, from the first on; or all"
    )
    burnt_in: Literal["auto", "no"] | Path = Field(
        "auto",
        description="logos, time codes and bars, which no stage takes for the scene: auto: find them, where the image "
        "moves enough; no; or a mask of your own, an image of the frames' size, white where something is burnt in",
    )

    @field_validator("burnt_in")
    @classmethod
    def _is_a_file(cls, value: str | Path) -> str | Path:
        if isinstance(value, Path) and not value.is_file():
            raise ValueError("auto, no, or an existing file")
        return value
