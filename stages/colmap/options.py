"""Options of the COLMAP baseline."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from stages.shared.options import MAX_SEED, Options

Factor = Annotated[Literal[1, 2, 4], BeforeValidator(lambda value: int(value) if str(value).isdigit() else value)]
"""Flags and Snakemake's --config pass numbers as text, which pydantic does not accept for a literal number."""


class ColmapOptions(Options):
    """COLMAP (pycolmap) on the same frames: the baseline of the pose table."""

    mappers: tuple[Literal["global", "incremental"], ...] = Field(
        ("global",), min_length=1, description="COLMAP's global (GLOMAP) and incremental mapping"
    )
    upsample: tuple[Factor, ...] = Field(
        (1,), min_length=1, description="factors by which frames are enlarged; 2 helps on small frames"
    )
    upsample_masked: tuple[Factor, ...] = Field(
        (), description="the same for runs with our masks (no features on dynamic pixels); no such run if empty"
    )
    matching: Literal["sequential", "exhaustive"] = Field(
        "sequential", description="match every frame with the next `window` frames, or with all"
    )
    window: int = Field(10, ge=1, le=200, description="frames ahead that sequential matching looks")
    time_limit_s: float = Field(600.0, ge=1.0, description="CPU seconds after which one variant counts as failed")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of COLMAP's random sampling")
