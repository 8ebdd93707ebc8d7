"""Options of optical flow."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from stages.shared.options import Options


class FlowOptions(Options):
    """Dense flow over an edge list, with forward-backward confidence."""

    source: Literal["dis", "truth"] = Field(
        "dis", description="dis: estimate it; truth: true flow of the sequence, to measure what errors of flow cost"
    )
    offsets: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5), min_length=1, description="frame distances of the edges, both ways; 1 among them"
    )
    long_edges: int = Field(
        2,
        ge=0,
        le=7,
        description="at most so many later frames, 8 to 64 frames on, that a frame is matched with besides, both ways:"
        " the furthest in which 30 % of it are still in view; each takes up to a quarter more time",
    )
    max_width_px: int = Field(512, ge=64, description="wider frames are reduced to this width before matching")
    finest_scale: int = Field(
        0,
        ge=0,
        le=3,
        description="finest pyramid level that is searched: 0 is full size; 1 takes less than half the"
        " time and has a third more error",
    )

    @field_validator("offsets")
    @classmethod
    def _links_neighbours(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        """Poses are chained, tracks followed and long edges started from frame to frame."""
        if 1 not in value:
            raise ValueError("1 among the frame distances")
        return value
