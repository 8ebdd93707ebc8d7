"""Options of the input check."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from stages.shared.dataset_folders import MIN_FRAMES
from stages.shared.options import Options


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


class PartOptions(InspectOptions):
    """Options of this script; those of a shot, which the workflow chooses, are flags only."""

    name: str | None = Field(None, description="name of the sequence; that of the folder if not given")
    first: int | None = Field(
        None, ge=0, description="number of the first frame, if the sequence is a shot of the folder"
    )
    last: int | None = Field(None, ge=0, description="number of the last frame of the shot")
    left_out: str = Field("", description="what is in no shot of the folder, in words")
