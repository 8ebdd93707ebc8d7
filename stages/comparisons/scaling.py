"""Collect the cost of every stage at every size into one table."""

import math
from pathlib import Path
from typing import Annotated

from stages.comparisons import made_under
from stages.shared import cli
from stages.shared.artifacts import read_json, read_model, read_table
from stages.shared.cli import In, Out
from stages.shared.images import reduced_size
from stages.shared.tables import Row, write_rows

COLUMNS = ("axis", "n", "stage", "wall_s", "cpu_s", "peak_mb", "output_mb")


def main(
    runs: Annotated[Path, In("runs.json: axis, and paths of sizes and costs relative to the dataset's folder")],
    output: Annotated[Path, Out("growth.parquet: a row per axis, size and stage")],
) -> None:
    """Write one row per axis, size and stage: seconds and megabytes written over all rounds, and the largest
    peak memory.
    """
    folder = runs.parents[1]
    listed = read_json(runs)["runs"]
    rows = [row for run in listed for row in run_rows(folder, run)]
    about = {"units": "n: of what the axis names; seconds; MB", "made_under": made_under.of_runs(folder, listed)}
    write_rows(output, rows, COLUMNS, about)


def run_rows(folder: Path, run: Row) -> list[Row]:
    """A row per measured stage of one run.

    Args:
        folder: of the dataset's results; paths in `run` are relative to it.
        run: sequence, axis, size (a file), stats (stage -> time files, one per round).
    """
    n = measure_size(run["axis"], folder / run["size"], folder / run["sequence"] / "sequence.json")
    rows = []
    for stage, files in run["stats"].items():
        spent = [read_json(folder / file) for file in files]
        sums = {name: sum(part[name] for part in spent) for name in ("wall_s", "cpu_s", "output_mb")}
        peak_mb = max(part["peak_mb"] for part in spent)
        rows.append({"axis": run["axis"], "n": n, "stage": stage, **sums, "peak_mb": peak_mb})
    return rows


def measure_size(axis: str, path: Path, sequence: Path) -> int:
    """The number of frames, pixels of the flow per frame, Gaussians or control points, from the artifact at `path`.

    Args:
        sequence: sequence.json. With the options in the time file of the flow it gives the size of the flow.
    """
    if axis == "frames":
        return len(read_json(path)["numbers"])
    if axis == "pixels":
        frames = read_json(sequence)
        return math.prod(reduced_size(frames["width"], frames["height"], read_json(path)["options"]["max_side_px"]))
    if axis == "gaussians":
        return len(read_model(path)["means"])
    return len(read_table(path)["x"])


if __name__ == "__main__":
    cli.run(main)
