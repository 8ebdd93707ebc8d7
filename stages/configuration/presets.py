"""Presets: values for options of several stages that trade accuracy for time."""

from collections.abc import Mapping
from typing import Any, Literal

Preset = Literal["fast", "balanced", "accurate"]
Overrides = dict[str, Any]
"""Option values by dotted name, as in {"flow.max_side_px": 384, "rounds": 3}."""

PRESETS: dict[Preset, Overrides] = {
    "fast": {
        "first_masks": "none",
        "flow.max_side_px": 320,
        "flow.offsets": (1, 2, 4),
        "flow.long_edges": 1,
        "ba.start_focals": (1.05,),
        "gaussians.steps": 400,
        "gaussians.stride_px": 3,
    },
    "balanced": {},
    "accurate": {
        "rounds": 5,
        "ba.stride_px": 4,
        "control.steps": 1000,
        "gaussians.steps": 2000,
    },
}
"""`balanced` is the defaults. `snakemake sweep` compares the presets on any sequences (its group `presets`); with an
option under `sweep: knobs:` it shows what that option contributes. Figures below are examples from a few sequences.

`fast` takes somewhat less than half of the CPU time of `balanced` from flow to poses. Its path error was 0.02 to 0.11 %
of the path, that of `balanced` 0.02 to 0.06 % (six sequences); on a fast and blurred sequence 0.38 and 0.22 %. Masks of
thin movers lose area. Smaller frames lose less accuracy than a coarser finest scale. The first poses are estimated
without masks. This does no harm unless movers fill nearly half of the view: there the error was 0.75 instead of 0.05 %,
and flagged.

`accurate` halves the stride of the adjustment. This doubles its time and lowers the path error by at most a tenth (four
sequences). It has one round more, for scenes half of which moves.
"""

FIXED_POSES: Overrides = {"rounds": 2, "first_masks": "none"}
"""Where poses are given and held fixed, the first round finds the depth, and the second the masks by poses and depth,
and the depth with these masks: no further round would move a pose. They win over the preset.
"""
FIXED_ALL: Overrides = {"rounds": 1}
"""The same where masks are not estimated either: the first round finds the depth with these masks."""


def override(raw: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a parsed config.yaml with option values replaced."""
    changed = dict(raw)
    for name, value in overrides.items():
        section, _, option = name.rpartition(".")
        changed |= {section: {**(changed.get(section) or {}), option: value}} if section else {option: value}
    return changed


def value_of(values: Mapping[str, Any], name: str) -> Any:
    """The value of an option by its dotted name; None if it is not set."""
    section, _, option = name.rpartition(".")
    inner = (values.get(section) or {}) if section else values
    return inner.get(option) if isinstance(inner, Mapping) else None
