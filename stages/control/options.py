"""Options of the dynamic control points."""

from pydantic import Field

from stages.shared.split import SplitOptions


class ControlOptions(SplitOptions):
    """Control points and their motion (stage 1)."""

    points: int = Field(512, ge=16, le=4096, description="number of control points")
    seed: int = Field(0, ge=0, description="seed of sampling and initial weights")
