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
        "rounds": 4,
        "ba.stride_px": 4,
        "control.steps": 1000,
        "gaussians.steps": 2000,
    },
}
"""Balanced is the defaults themselves.

Fast takes a third of the CPU time of balanced from flow to poses (13 against 40 s for 30 frames, 512 x 218 px; flow
alone 5 against 17). Its path error is 0.02 to 0.11 % where that of balanced is 0.02 to 0.06 (six sequences), 0.38
against 0.22 in a fast and blurred one; thin movers lose half of their masks. Smaller frames cost less than stopping at
a coarser scale. Its first poses do without masks, at no loss but where movers fill near half of the view: there 0.75
against 0.05 %, flagged. It keeps two rounds: one leaves masks of a large mover at an IoU of 0.11 instead of 0.98.

Accurate: half the stride of the adjustment doubles its time and lowers the path error by a tenth at best (four
sequences); the third round brings masks of a scene that moves by half from 0.65 to 0.97.
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
