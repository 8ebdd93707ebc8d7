"""Options of the comparisons: the settings of a sweep, and the sizes over which the growth of cost is measured."""

from typing import Annotated, Any, Literal

from pydantic import Field

from stages.configuration.presets import Overrides, Preset
from stages.shared.options import Options

Knobs = dict[str, list[Any]]
"""Values to try, by the dotted name of an option: {"ba.stride_px": [4, 8, 16]}."""

GROWING: dict[str, tuple[str, ...]] = {
    "frames": ("inspect", "flow", "lens", "motion", "segment", "ba", "scene", "control", "gaussians", "render"),
    "pixels": ("flow", "lens", "motion", "segment", "ba"),
    "gaussians": ("gaussians", "render"),
    "control points": ("control", "gaussians", "render"),
}
"""Sizes that can be varied, and the stages whose cost is measured against each."""


class SweepOptions(Options):
    """What `snakemake sweep` compares."""

    sequences: Literal["first", "all"] | list[str] = Field(
        "first", description="which of the chosen sequences: first, all, or a list of names"
    )
    groups: Literal["all"] | Annotated[list[str], Field(min_length=1)] = Field(
        "all", description="which groups of settings: all, or a list of presets, knobs and names under runs"
    )
    presets: list[Preset] = Field([], description="presets to run")
    knobs: Knobs = Field({}, description="options to vary one at a time, with values; the configured value is added")
    runs: dict[str, dict[str, Overrides | None] | None] = Field(
        {}, description="group, name, and the options in which that run differs"
    )


class ScalingOptions(Options):
    """What `snakemake scaling` measures."""

    sequences: Literal["first", "all"] | list[str] = Field(
        "first", description="which of the chosen sequences: first, all, or a list of names"
    )
    axes: dict[Literal["frames", "pixels", "gaussians", "control points"], Knobs] = Field(
        {}, description="what grows, and the options that make it grow"
    )
