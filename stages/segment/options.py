"""Options of mask refinement."""

from typing import Literal

from pydantic import Field

from stages.given.files import GivenPath
from stages.shared.options import Options


class SegmentOptions(Options):
    """Motion prior to refined dynamic masks."""

    source: Literal["refined", "prior", "none", "truth"] | GivenPath = Field(
        "refined",
        description="masks for all later stages: refined, the prior above one half, none, the true motion masks, or the"
        " path of a folder of masks, one per frame; {sequence} in it stands for the name of the sequence",
    )
    evidence: GivenPath | None = Field(
        None, description="folder of masks that refined masks take as strong evidence beside the motion prior"
    )
    threshold: float = Field(
        0.33,
        ge=0.05,
        le=0.95,
        description="least probability, over the clip, of what is dynamic; a whole mover needs 1.3 times as much, "
        "and 1.6 times where pictures do not show that it moves",
    )
    permanence: float = Field(
        3.0,
        ge=0,
        le=100,
        description="weight of links along the flow against evidence; 0: each frame alone",
    )
    smoothness: float = Field(
        1000.0,
        ge=0,
        le=1e5,
        description="weight of edge-aware smoothing of the masks' borders, for 512 px along the longer side",
    )
    colour_sigma: float = Field(
        3.0, gt=0, le=100, description="colour step (0..255) that stops the smoothing; smaller follows finer edges"
    )
    borders: Literal["learned", "geometric"] = Field(
        "learned",
        description="what decides near the borders of refined masks, from the second round on: a small network, trained"
        " on drawn scenes, that weighs the evidence, or the evidence as it is",
    )
    min_area: float = Field(
        5e-4, ge=0, le=0.1, description="regions smaller than this share of the frame are dropped, holes filled"
    )
    max_share: float = Field(
        0.85,
        gt=0,
        le=1,
        description="largest share of a frame that may be dynamic; beyond it only the surest pixels are",
    )

    @property
    def estimates(self) -> bool:
        """Whether the masks come from the motion prior, and not from the truth or the user."""
        return self.source in ("refined", "prior")

    @property
    def given(self) -> str | None:
        """The path of the masks that the user hands in, if they are used as they are."""
        return None if self.source in ("refined", "prior", "none", "truth") else self.source
