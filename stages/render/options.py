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
        description="how far the fly-through leaves the estimated path, as a share of the median depth",
    )
    export_frames: Literal["all"] | tuple[int, ...] = Field(
        (), description="numbers of the frames whose splats, as they are then, are written as PLY; or all"
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to render")

    def exports(self, number: int) -> bool:
        """Whether the splats of a frame are asked for."""
        return self.export_frames == "all" or number in self.export_frames


class ViewOptions(Options):
    """Any time and camera."""

    at_time: float | None = Field(None, ge=0, le=1, description="moment of all images, 0..1 over the sequence")
    width_px: int | None = Field(None, ge=1, description="width of the images; default: that of the frames")
    height_px: int | None = Field(None, ge=1, description="height of the images; default: that of the frames")
    splats: bool = Field(False, description="write the splats of each moment as PLY beside the image")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to render")
