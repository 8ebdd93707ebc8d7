"""Options of the lens stage."""

from typing import Literal

from pydantic import Field

from stages.shared.options import MAX_SEED, Options


class LensOptions(Options):
    """Radial distortion of the lens, decided and removed before the stages that assume a pinhole camera."""

    distortion: Literal["auto", "yes", "no"] = Field(
        "auto", description="whether frames are undistorted; auto: if that explains held-out pixels of the flow"
    )
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of the robust two-view fits")
