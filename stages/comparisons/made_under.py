"""Options, code and frames of a run, to check whether an earlier comparison is still valid."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_json, read_metadata
from stages.shared.tables import Row, read_rows

Made = dict[str, Any]
"""For one sequence: "frames" (digest of the input) and, by stage, its "options", its "code" and how often it "ran"."""
UNKNOWN = "its options are not recorded"


def read_made(folder: Path, runs: Mapping[str, int]) -> Made:
    """Options, code and frames of the run whose results are in the folder of a sequence.

    Args:
        runs: number of rounds of each stage, by name. The time file is that of the last round.
    """
    made: Made = {"frames": read_json(folder / "sequence.json").get("frames_sha256")}
    for stage, count in runs.items():
        content = read_json(folder / f"stats/{stage}.json")
        made[stage] = {"options": content["options"], "code": content["code"], "ran": count}
    return made


def of_runs(folder: Path, runs: Sequence[Row]) -> dict[str, Made]:
    """Options, code and frames of the configured run that belongs to a comparison, by sequence.

    Args:
        folder: of the dataset's results.
        runs: of runs.json, each with its "sequence" and its "stages", the number of rounds of each stage.
    """
    return {run["sequence"]: read_made(folder / run["sequence"], run["stages"]) for run in runs}


def differences(table: Path, folder: Path) -> list[str]:
    """Differences, in words, between the configured run of a comparison and the present results.

    Args:
        table: of the sweep or the scaling; its metadata describe the configured run.
        folder: of the dataset's results, evaluated.
    """
    made = read_metadata(table).get("made_under")
    if not made:
        return [UNKNOWN]
    found: list[str] = []
    for name, then in made.items():
        now = _now(folder / name, then)
        found += [f"{name} is not evaluated"] if now is None else _compare(then, now)
    return list(dict.fromkeys(found))


def _now(folder: Path, then: Made) -> Made | None:
    times = folder / "eval/time.parquet"
    if not times.exists():
        return None
    ran = [row["stage"] for row in read_rows(times)]
    return read_made(folder, {stage: ran.count(stage) for stage in then if stage != "frames"})


def _compare(then: Made, now: Made) -> list[str]:
    found = [] if then["frames"] == now["frames"] else ["other frames"]
    for stage, was in then.items():
        if stage == "frames":
            continue
        found += [f"{stage} ran {was['ran']} times, now {now[stage]['ran']}"] if was["ran"] != now[stage]["ran"] else []
        found += _options(stage, was["options"], now[stage]["options"])
        found += [f"{stage} by other code"] if was["code"] != now[stage]["code"] else []
    return found


def _options(stage: str, then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    names = [name for name in {**then, **now} if then.get(name) != now.get(name)]
    return [f"{stage}.{name} {then.get(name)}, now {now.get(name)}" for name in names]
