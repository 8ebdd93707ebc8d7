"""Options of the motion prior."""

from pydantic import Field

from stages.shared.options import Options


class MotionOptions(Options):
    """Probability that a pixel moves in the world, from geometry alone."""

    seed: int = Field(0, ge=0, description="seed of the robust two-view fits")
