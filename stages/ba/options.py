"""Options of the pose stage."""

from typing import Annotated, Literal

from pydantic import Field

from stages.given.files import GivenPath
from stages.given.intrinsics import ESTIMATE, IntrinsicsOption
from stages.shared.options import MAX_SEED, Options


class BAOptions(Options):
    """Initial poses and focal length, then masked dense bundle adjustment."""

    intrinsics: IntrinsicsOption = Field(
        ESTIMATE,
        description="estimate one shared focal length, or where K comes from: truth, exif, a focal length as in "
        "'1200 px' or '26 mm / 36 mm', 'fx, fy, cx, cy', or a COLMAP cameras.txt",
    )
    zoom: Literal["auto", "yes", "no"] = Field(
        "auto", description="whether the focal length changes over the frames; auto: if that explains held-out pixels"
    )
    rolling_shutter: Literal["auto", "yes", "no"] = Field(
        "auto", description="whether rows are exposed one after the other; auto: if that explains held-out pixels"
    )
    poses_from: Literal["estimate", "truth"] | GivenPath = Field(
        "estimate",
        description="estimate cameras, or take the true poses and K, or those of a TUM file, the folder of a COLMAP "
        "model or a transforms.json; {sequence} in its path stands for the name of the sequence",
    )
    poses_as: Literal["fixed", "start"] = Field(
        "fixed", description="given poses are held fixed, so that the depth alone is estimated, or adjusted from there"
    )
    depth_from: Literal["estimate", "truth"] | GivenPath = Field(
        "estimate", description="depth that is written: estimated, true, or that of a folder of maps, one per frame"
    )
    start_focals: tuple[Annotated[float, Field(ge=0.3, le=5)], ...] = Field(
        (0.8, 1.05, 1.4),
        min_length=1,
        description="initial focal lengths of the first round, in longer sides of the image",
    )
    stride_px: int = Field(
        8, ge=2, le=32, description="one inverse depth per this many pixels of the flow, each way, while solving poses"
    )
    depth_stride_px: int = Field(
        4, ge=1, le=32, description="one inverse depth per this many pixels of the flow, each way, in the depth written"
    )
    iterations: int = Field(
        15,
        ge=1,
        le=200,
        description="largest number of iterations of the final adjustment at each robust scale; it ends at convergence",
    )
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of the robust two-view fits")

    @property
    def poses_fixed(self) -> bool:
        """Whether poses are given and held fixed."""
        return self.poses_from != ESTIMATE and self.poses_as == "fixed"
