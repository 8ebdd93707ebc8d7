"""Options of optical flow and of the motion prior."""

from pydantic import Field

from stages.shared.options import Options


class FlowOptions(Options):
    """Dense flow over an edge list, with forward-backward confidence."""

    offsets: tuple[int, ...] = Field((1, 2, 3, 5), min_length=1, description="frame distances of the edges, both ways")
    max_width_px: int = Field(512, ge=64, description="wider frames are reduced to this width before matching")


class MotionOptions(Options):
    """Probability that a pixel moves in the world, from geometry alone."""
