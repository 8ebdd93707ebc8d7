"""Options of evaluation, of the COLMAP baseline and of the report."""

from pydantic import Field

from stages.shared.options import Options
from stages.shared.split import SplitOptions


class EvaluateOptions(SplitOptions):
    """Scores of poses, images and masks."""


class ColmapOptions(Options):
    """pycolmap on the same frames, the baseline of the pose table."""

    seed: int = Field(0, ge=0, description="seed of COLMAP's random sampling")


class ReportOptions(Options):
    """The HTML report."""

    title: str = Field("motionsplat report", description="title of the page")
