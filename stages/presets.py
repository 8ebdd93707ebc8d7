"""Presets: sets of option values that move the knobs of several stages together."""

from collections.abc import Mapping
from typing import Any, Literal

Preset = Literal["fast", "balanced", "accurate"]
Overrides = dict[str, Any]
"""Option values by dotted name, as in {"flow.max_width_px": 384, "rounds": 3}."""

PRESETS: dict[Preset, Overrides] = {
    "fast": {
        "first_masks": "none",
        "flow.max_width_px": 320,
        "flow.offsets": (1, 2, 4),
        "flow.long_edges": 1,
        "ba.start_focals": (1.05,),
        "control.steps": 200,
        "gaussians.steps": 400,
        "gaussians.stride_px": 3,
    },
    "balanced": {},
    "accurate": {
        "rounds": 3,
        "ba.stride_px": 4,
        "control.steps": 1000,
        "gaussians.steps": 2000,
    },
}
"""Balanced is the defaults themselves.

Fast takes 20 CPU s from flow to poses where balanced takes 37 (30 frames, 512 x 218 px; flow alone 7 against 18), and
its path error is 0.04 against 0.02 % there, 0.03 to 0.09 against 0.03 to 0.06 % on four other sequences. Smaller frames
cost less accuracy than stopping at a coarser scale: half-size flow of full frames takes 27 CPU s, at 0.11 %. It keeps
two rounds: one leaves masks of a large mover at an IoU of 0.11 instead of 0.98.
"""


def override(raw: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A parsed config.yaml with option values replaced; `raw` stays as it is."""
    changed = dict(raw)
    for name, value in overrides.items():
        section, _, option = name.rpartition(".")
        changed |= {section: {**(changed.get(section) or {}), option: value}} if section else {option: value}
    return changed


def value_of(values: Mapping[str, Any], name: str) -> Any:
    """The value of an option by its dotted name; None where it is not set."""
    section, _, option = name.rpartition(".")
    inner = (values.get(section) or {}) if section else values
    return inner.get(option) if isinstance(inner, Mapping) else None
