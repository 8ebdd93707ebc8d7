"""Options of evaluation, of the COLMAP baseline and of the report."""

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator

from stages.shared.options import Options
from stages.shared.split import SplitOptions


class EvaluateOptions(SplitOptions):
    """Scores of poses, images and masks."""

    lpips_weights: Path | None = Field(
        None,
        description="file with the state dict of lpips.LPIPS(net='alex'), as torch saves it; without it LPIPS is n/a",
    )

    @field_validator("lpips_weights")
    @classmethod
    def _is_a_file(cls, value: Path | None) -> Path | None:
        if value is not None and not value.is_file():
            raise ValueError("an existing file")
        return value


class ColmapOptions(Options):
    """pycolmap on the same frames, the baseline of the pose table."""

    mappers: tuple[Literal["global", "incremental"], ...] = Field(
        ("global",), min_length=1, description="COLMAP's global (GLOMAP) and incremental mapping"
    )
    upsample: tuple[Literal[1, 2, 4], ...] = Field(
        (1,), min_length=1, description="run on frames enlarged by these factors; 2 helps small frames, costs 3 times"
    )
    upsample_masked: tuple[Literal[1, 2, 4], ...] = Field(
        (), description="the same with features on dynamic pixels left out, by our masks; none of it if empty"
    )
    matching: Literal["sequential", "exhaustive"] = Field(
        "sequential", description="match every frame with the next `window` frames, or with all"
    )
    window: int = Field(10, ge=1, le=200, description="frames ahead that sequential matching looks")
    time_limit_s: float = Field(600.0, ge=1.0, description="CPU seconds after which one variant counts as failed")
    seed: int = Field(0, ge=0, description="seed of COLMAP's random sampling")


class ReportOptions(Options):
    """The HTML report."""

    title: str = Field("motionsplat report", description="title of the page")


class ResultsOptions(Options):
    """The page of results."""

    command: str = Field("", description="what made the results, as the page shall say it, e.g. make results")
