"""Entries of scene.json on effects of the camera, which the adjustment and the lens stage decide before."""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Source(NamedTuple):
    """One effect: its word for "it is there", the number that says how strong it is, and the option that overrules."""

    present: str
    strength: str
    option: str


ADJUSTED = {
    "zoom": Source("changing", "change", "zoom"),
    "rolling_shutter": Source("rolling", "readout", "rolling_shutter"),
}
DISTORTION = Source("distorted", "shift", "distortion")
SIGMAS = 2.0
"""Half of the interval, in standard errors."""
UNIT = "% of the cost of held-out pixels"


def camera_decisions(adjusted: Mapping[str, Any], lens: Mapping[str, Any] | None) -> dict[str, dict[str, Any]]:
    """Decisions about zoom, rolling shutter and lens distortion, in the form of `rules`.

    The statistic is the share of the cost of held-out pixels that the effect saves; None where it was not tested.

    Args:
        adjusted: metadata of ba/poses.parquet; cameras from elsewhere have no decisions.
        lens: content of lens.json; None: frames are taken as they are.
    """
    there = {effect: source for effect, source in ADJUSTED.items() if effect in adjusted}
    found = {effect: _decision(adjusted[effect], source, adjusted["options"]) for effect, source in there.items()}
    return found | ({"distortion": _decision(lens, DISTORTION, lens["options"])} if lens else {})


def _decision(evidence: Mapping[str, Any], source: Source, options: Mapping[str, Any]) -> dict[str, Any]:
    gain, sigma = evidence["gain"], evidence["gain_sigma"] or 0.0
    tested = gain is not None
    return {
        "needed": evidence["decision"] == source.present,
        "statistic": 100 * gain if tested else None,
        "interval": [100 * (gain - SIGMAS * sigma), 100 * (gain + SIGMAS * sigma)] if tested else [None, None],
        "threshold": 100 * evidence["threshold"] if tested else None,
        "unit": UNIT,
        "evidence": {name: evidence[name] for name in (source.strength, f"{source.strength}_sigma")},
        "why": f"{evidence['decision']}: {evidence['reason']}",
        "source": "evidence" if options[source.option] == "auto" else "user",
        "seconds": round(evidence["seconds"], 3),
    }
