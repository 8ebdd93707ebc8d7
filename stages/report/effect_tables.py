"""Rows on effects: those that the reconstruction models, with evidence, and those that the simulator rendered."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_json
from stages.shared.tables import Row

JUDGED = ("needed", "statistic", "interval", "threshold", "unit", "seconds", "evidence", "why", "source")
"""What every decision has; the rest are settings of the effect."""


def simulation_rows(manifests: Path | None, name: str, clip: str) -> list[Row]:
    """A row per effect that the simulator rendered or left out of a sequence, from `<manifests>/<clip>.json`."""
    path = manifests / f"{clip}.json" if manifests else None
    if path is None or not path.exists():
        return []
    content = read_json(path)
    seconds, calls = content["seconds"], content["calls"]
    rows = [
        {"effect": effect, "simulated": "yes", "settings": _words(settings)}
        for effect, settings in content["effects"].items()
    ]
    rows += [{"effect": effect, "simulated": "no", "settings": ""} for effect in content["not_simulated"]]
    return [
        {"sequence": name, **row, "effect": row["effect"].replace("_", " ")}
        | {"seconds": seconds.get(row["effect"], 0.0), "calls": calls.get(row["effect"], 0)}
        for row in rows
    ]


def decision_rows(folder: Path) -> list[dict[str, Any]]:
    """A row per decision in scene.json of a sequence, with its evidence in words."""
    path = folder / "scene.json"
    if not path.exists():
        return []
    rows = []
    for effect, decision in read_json(path).items():
        if isinstance(decision, dict) and "needed" in decision:
            rows.append({"sequence": folder.name, "effect": effect.replace("_", " ")} | _decision(decision))
    return rows


def _decision(decision: Mapping[str, Any]) -> dict[str, Any]:
    settings = {name: value for name, value in decision.items() if name not in JUDGED}
    low, high = decision.get("interval", (None, None))
    return {
        "modelled": "yes" if decision["needed"] else "no",
        **{name: decision.get(name) for name in ("statistic", "threshold", "unit", "seconds")},
        "low": low,
        "high": high,
        "why": decision["why"],
        "source": decision["source"],
        "settings": _words(settings),
        "evidence": _words(decision["evidence"]),
    }


def _words(values: Mapping[str, Any]) -> str:
    """`name value` pairs with four significant digits."""
    shown = {name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in values.items()}
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in shown.items())
