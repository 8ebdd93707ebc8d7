"""Options of the motion prior."""

from pydantic import Field

from stages.shared.options import MAX_SEED, Options


class MotionOptions(Options):
    """Probability that a pixel moves in the world, from geometry alone."""

    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of the robust two-view fits")
