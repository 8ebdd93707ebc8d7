"""Options of the input check."""

from typing import Annotated, Literal

from pydantic import Field

from stages.shared.options import Options
from stages.shared.sequences import MIN_FRAMES


class InspectOptions(Options):
    """Which frames are used."""

    max_frames: Literal["all"] | Annotated[int, Field(ge=MIN_FRAMES)] = Field(
        "all", description="number of frames to use, from the first on; or all"
    )
