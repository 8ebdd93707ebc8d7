"""Options of optical flow."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from stages.given.files import GivenPath
from stages.shared.options import Options


class FlowOptions(Options):
    """Dense flow over an edge list, with forward-backward confidence."""

    source: Literal["dis", "truth"] | GivenPath = Field(
        "dis",
        description="dis: estimate it; truth: true flow of the sequence, to measure what errors of flow cost; or the"
        " path of a folder of flow between frames: the rest is estimated",
    )
    offsets: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (1, 2, 3, 5), min_length=1, description="frame distances of the edges, both ways; 1 among them"
    )
    long_edges: int = Field(
        2,
        ge=0,
        le=7,
        description="long edges per frame, both ways: at most so many later frames, 8 to 64 frames ahead, the furthest"
        " that still show 30 % of the frame; each costs time",
    )
    loops: Literal["auto", "no"] = Field(
        "auto",
        description="frames more than 64 apart that show the same place again: auto: found, checked and joined, at most"
        " two edges each, but not with true flow; no: none",
    )
    max_side_px: int = Field(512, ge=64, description="larger frames are reduced to this longer side before matching")
    finest_scale: int = Field(
        0,
        ge=0,
        le=3,
        description="finest pyramid level that is searched: 0 is full size; 1 is faster and less accurate",
    )

    @field_validator("offsets")
    @classmethod
    def _links_neighbours(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        """Require distance 1: poses, tracks and long edges are chained over neighbouring frames."""
        if 1 not in value:
            raise ValueError("1 among the frame distances")
        return value

    @property
    def given(self) -> str | None:
        """The path of the flow that the user hands in."""
        return None if self.source in ("dis", "truth") else self.source
