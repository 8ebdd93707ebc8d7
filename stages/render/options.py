"""Options of rendering."""

from typing import Literal

from pydantic import Field

from stages.shared.options import Options
from stages.shared.split import SplitOptions


class RenderOptions(SplitOptions):
    """Train, held-out and novel views, and a video."""

    novel_views: int = Field(24, ge=2, le=1000, description="frames of the fly-through")
    orbit_share: float = Field(
        0.03,
        ge=0,
        le=1,
        description="distance of the fly-through from the estimated path, as a share of the median depth",
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to render")


class ViewOptions(Options):
    """Renders at any time from any camera."""

    at_time: float | None = Field(None, ge=0, le=1, description="time of all images, 0..1 over the sequence")
    width_px: int | None = Field(None, ge=1, description="width of the images; default: that of the frames")
    height_px: int | None = Field(None, ge=1, description="height of the images; default: that of the frames")
    splats: bool = Field(False, description="write the splats at the time of each image as PLY beside it")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to render")
