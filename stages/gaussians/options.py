"""Options of Gaussian training and rendering."""

from typing import Literal

from pydantic import Field

from stages.shared.split import SplitOptions


class GaussiansOptions(SplitOptions):
    """Two-stage training of the 4D Gaussian scene (stage 2)."""

    steps: int = Field(400, ge=1, description="optimisation steps")
    seed: int = Field(0, ge=0, description="seed of the order of frames")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to train")


class RenderOptions(SplitOptions):
    """Train, held-out and novel views, and a video."""

    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to render")
