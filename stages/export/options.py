"""Options of the export."""

from typing import Literal

from pydantic import Field

from stages.shared.options import Options

Format = Literal["colmap", "nerfstudio", "npz", "depth_png", "masks", "ply", "spz", "video"]


class ExportOptions(Options):
    """What others read, and of which frames."""

    formats: tuple[Format, ...] = Field(
        ("colmap", "nerfstudio", "npz", "depth_png", "masks", "spz", "video"),
        min_length=1,
        description="what is written: colmap, nerfstudio, npz, depth_png, masks, ply, spz, video",
    )
    splat_frames: Literal["all"] | tuple[int, ...] = Field(
        "all", description="numbers of the frames whose splats, moved to that time, are written as ply and spz; or all"
    )

    def writes(self, *formats: Format) -> bool:
        """Whether one of these formats is asked for."""
        return not set(formats).isdisjoint(self.formats)

    def writes_splats_of(self, number: int) -> bool:
        """Whether the splats of the frame with this number are written."""
        return self.splat_frames == "all" or number in self.splat_frames
