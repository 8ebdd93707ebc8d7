"""Time and memory of every stage, from the time files that the stages write."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from stages.shared.artifacts import read_json
from stages.shared.chain import AFTER, BEFORE, REPEATED
from stages.shared.tables import Row

LAST = (*AFTER[:-1], "colmap", "colmap_masked")
"""The stages after the rounds, in the order of the tables."""


def time_rows(name: str, files: Sequence[Path]) -> list[Row]:
    """A row per file `.../stats/<stage>.json`, in the order in which the stages run.

    Args:
        files: those of a repeated stage in the order of the rounds (not told by their folders, which runs share).
    """
    of_stage = Counter(path.stem for path in files)
    rounds, seen, rows = max(of_stage.values()), Counter[str](), []
    # Masks that are not estimated are made once, before the rounds.
    repeated = REPEATED if of_stage["motion"] else ("ba",)
    for path in files:
        seen[path.stem] += 1
        # The first round may have no masks, the last one always has.
        number = rounds - of_stage[path.stem] + seen[path.stem]
        rows.append(_time_row(name, path, number if path.stem in repeated else None))
    return sorted(rows, key=_stage_order)


def spent_to_poses(rows: Sequence[Row], rounds: int) -> list[tuple[float, float, int]]:
    """Wall and CPU seconds from the frames to the poses of each round, and the most threads of any stage of it."""
    spent = []
    for k in range(1, rounds + 1):
        once = (*BEFORE[1:], "segment")
        before = [row for row in rows if row["stage"] in once and row["round"] is None]
        part = before + [row for row in rows if row["round"] is not None and row["round"] <= k]
        seconds = (sum(row[key] for row in part) for key in ("wall_s", "cpu_s"))
        spent.append((*seconds, max(row["threads"] for row in part)))
    return spent


def is_ours(row: Row) -> bool:
    """Whether a row of the time table is a stage of ours and not the baseline."""
    return not str(row["stage"]).startswith("colmap")


def _time_row(name: str, path: Path, number: int | None) -> Row:
    content = read_json(path)
    costs = {key: content[key] for key in ("threads", "wall_s", "cpu_s", "peak_mb", "gpu_peak_mb", "output_mb")}
    return {"sequence": name, "stage": path.stem, "round": number} | costs


def _stage_order(row: Row) -> tuple[int, ...]:
    """Stages before the rounds, each round, stages after them."""
    stage = row["stage"]
    if row["round"] is not None:
        return 1, row["round"], REPEATED.index(stage)
    before = (*BEFORE, "segment")
    return 0 if stage in before else 2, (before if stage in before else LAST).index(stage)
