"""Options of the decoding of videos."""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from stages.shared.dataset_folders import MIN_FRAMES
from stages.shared.options import Options


class VideoOptions(Options):
    """Which frames of a video are used, and at which size."""

    start: float = Field(0, ge=0, description="time in the video at which to begin, s")
    end: Annotated[float, Field(gt=0)] | None = Field(
        None, description="time in the video at which to stop, s; its end if not given"
    )
    every: int = Field(1, ge=1, description="one frame in this many is used")
    max_side: int = Field(1024, ge=64, description="larger frames are reduced to this longer side, px")
    max_frames: Literal["all"] | Annotated[int, Field(ge=MIN_FRAMES)] = Field(
        200, description="largest number of frames to use of a video, from `start` on; or all"
    )

    @field_validator("end")
    @classmethod
    def _after_start(cls, end: float | None, info: ValidationInfo) -> float | None:
        """Refuse an end that is not after the start."""
        start = info.data.get("start", 0)
        if end is not None and end <= start:
            raise ValueError(f"a time after `start`, {start:g} s")
        return end
