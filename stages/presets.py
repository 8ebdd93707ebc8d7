"""Presets: sets of option values that move the knobs of several stages together."""

from collections.abc import Mapping
from typing import Any, Literal

Preset = Literal["fast", "balanced", "accurate"]
Overrides = dict[str, Any]
"""Option values by dotted name, as in {"flow.finest_scale": 1, "rounds": 3}."""

PRESETS: dict[Preset, Overrides] = {
    "fast": {
        "flow.finest_scale": 1,
        "ba.stride_px": 16,
        "control.steps": 200,
        "gaussians.steps": 400,
        "gaussians.stride_px": 3,
    },
    "balanced": {},
    "accurate": {
        "rounds": 3,
        "ba.stride_px": 4,
        "gaussians.steps": 4000,
    },
}
"""Balanced is the defaults themselves."""


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
