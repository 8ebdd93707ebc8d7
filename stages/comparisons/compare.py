"""Compare two runs: the paired difference per sequence of two result folders, printed and drawn."""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.evaluate.costs import is_ours
from stages.evaluate.score_masks import PRIOR
from stages.shared.atomic import atomic
from stages.shared.charts import COLOURS, OTHERS, figure
from stages.shared.errors import InputError
from stages.shared.tables import Row, decimal, read_rows

Values = dict[str, float | None]


@dataclass(frozen=True)
class Measure:
    """A score that is compared; `sign` is +1 if larger values are better, -1 if smaller ones are.

    Attributes:
        noise: largest loss of a sequence that counts as none; None for measures that no sequence is held to.
    """

    key: str
    label: str
    unit: str
    sign: int
    digits: int
    noise: float | None = None


MEASURES = (
    Measure("ate_percent", "ATE", "% of path", -1, 3, 0.02),
    Measure("focal_abs_percent", "focal error", "%, size", -1, 2),
    Measure("iou", "mask IoU", "0..1", 1, 3, 0.01),
    Measure("psnr_whole", "PSNR", "dB", 1, 2, 0.1),
    Measure("psnr_static", "PSNR static", "dB", 1, 2, 0.1),
    Measure("psnr_dynamic", "PSNR dynamic", "dB", 1, 2, 0.1),
    Measure("wall_s", "time", "s", -1, 1),
    Measure("cpu_s", "CPU time", "s", -1, 1),
)
RELATIVE_NOISE = 0.1
"""A loss of ATE by this share of it counts as none either."""
SLOWER = 1.03
"""Largest ratio of the CPU seconds of all sequences that counts as equal. Those of one sequence vary more."""


def read_run(folder: Path) -> dict[str, Values]:
    """Our scores by sequence, from a folder results/<dataset>.

    Raises:
        InputError: if it holds no evaluated sequence.
    """
    found = sorted(path.parents[1] for path in folder.glob("*/eval/poses.parquet"))
    if not found:
        have = "nothing evaluated" if folder.is_dir() else "no such folder"
        advice = "name a folder results/<dataset> whose sequences hold eval/poses.parquet"
        raise InputError(folder, "a result folder", have, advice)
    return {path.name: read_sequence(path / "eval") for path in found}


def read_sequence(scores: Path) -> Values:
    """Our scores of one sequence by measure; None where a part failed or ground truth is missing."""
    pose = _only(read_rows(scores / "poses.parquet"), method="ours")
    focal = pose.get("focal_error_percent")
    values: Values = {
        "ate_percent": pose.get("ate_percent") if pose.get("status") == "ok" else None,
        "focal_abs_percent": None if focal is None else abs(focal),
    }
    rounds = [row for row in read_rows(scores / "masks.parquet") if row["method"] != PRIOR]
    values["iou"] = max(rounds, key=lambda row: row["round"])["iou"] if rounds else None
    images = read_rows(scores / "images.parquet")
    for region in ("whole", "static", "dynamic"):
        values[f"psnr_{region}"] = _only(images, method="ours", split="test", region=region).get("psnr_db")
    times = [row for row in read_rows(scores / "time.parquet") if is_ours(row)]
    values["threads"] = max(row["threads"] for row in times)
    return values | {key: float(sum(row[key] for row in times)) for key in ("wall_s", "cpu_s")}


def _only(rows: Iterable[Row], **wanted: str) -> Row:
    return next((row for row in rows if all(row[key] == value for key, value in wanted.items())), {})


def differences(a: Mapping[str, Values], b: Mapping[str, Values], measure: Measure) -> dict[str, float]:
    """Differences B - A by sequence, for sequences with the value in both runs."""
    pairs = {name: (a[name][measure.key], b[name][measure.key]) for name in a if name in b}
    return {name: y - x for name, (x, y) in pairs.items() if x is not None and y is not None}


def describe(a: Mapping[str, Values], b: Mapping[str, Values]) -> str:
    """Both runs, their differences and a summary of these, as a table per measure in plain text."""
    lines = []
    for name, present, other in (("A", a, b), ("B", b, a)):
        only = sorted(set(present) - set(other))
        lines += [f"only in {name}: {', '.join(only)}"] if only else []
    most = (max(int(values["threads"] or 0) for values in run.values()) for run in (a, b))
    lines.append("threads at most: A {}, B {}".format(*most))
    for measure in MEASURES:
        title = f"{measure.label} ({measure.unit}, {'more' if measure.sign > 0 else 'less'} is better)"
        lines += ["", f"{title:<36}{'A':>10}{'B':>10}   B - A"]
        lines += [_line(name, a, b, measure) for name in sorted(set(a) | set(b))]
        lines.append(f"  {summarise(list(differences(a, b, measure).values()), measure)}{_unpaired(a, b, measure)}")
    return "\n".join(lines).strip()


def _line(name: str, a: Mapping[str, Values], b: Mapping[str, Values], measure: Measure) -> str:
    values = [run[name][measure.key] if name in run else None for run in (a, b)]
    x, y = values
    cells = ["n/a" if value is None else decimal(value, measure.digits) for value in values]
    change = "" if x is None or y is None else f"{y - x:+.{measure.digits}f} {_verdict(y - x, measure)}"
    return f"  {name:<34}{cells[0]:>10}{cells[1]:>10}   {change}".rstrip()


def _unpaired(a: Mapping[str, Values], b: Mapping[str, Values], measure: Measure) -> str:
    """Number of sequences with the value in one of the runs alone, since differences do not show failures."""
    known = [(a[name][measure.key] is not None, b[name][measure.key] is not None) for name in a if name in b]
    lost, gained = known.count((True, False)), known.count((False, True))
    return f"; {lost} lost by B, {gained} gained" if lost or gained else ""


def _verdict(change: float, measure: Measure) -> str:
    return "" if change == 0 else "better" if change * measure.sign > 0 else "worse"


def summarise(changes: Sequence[float], measure: Measure) -> str:
    """Mean and median of the paired differences, and the number of sequences on which B is better."""
    if not changes:
        return "no sequence has the value in both"
    signed = np.array(changes)
    better, worse = (int(np.sum(signed * measure.sign * s > 0)) for s in (1, -1))
    mean, median = f"{signed.mean():+.{measure.digits}f}", f"{np.median(signed):+.{measure.digits}f}"
    counts = f"B better {better}, worse {worse}, equal {len(signed) - better - worse}; n = {len(signed)}"
    return f"B - A: mean {mean}, median {median}; {counts}"


def losses(a: Mapping[str, Values], b: Mapping[str, Values]) -> list[str]:
    """Where B is worse than A beyond the noise, a line each: scores by sequence, CPU seconds over all of both."""
    found = [f"{name}: only in A" for name in sorted(set(a) - set(b))]
    both = sorted(set(a) & set(b))
    for measure in MEASURES:
        for name in both if measure.noise is not None else ():
            x, y = a[name][measure.key], b[name][measure.key]
            if x is not None and (y is None or _is_loss(x, y, measure)):
                to = "none" if y is None else decimal(y, measure.digits)
                found.append(f"{name}: {measure.label} {decimal(x, measure.digits)} -> {to}")
    before, after = (sum(run[name]["cpu_s"] or 0.0 for name in both) for run in (a, b))
    return [*found, *([f"all: CPU time {before:.1f} -> {after:.1f} s"] if after > SLOWER * before else [])]


def _is_loss(x: float, y: float, measure: Measure) -> bool:
    noise = max(measure.noise or 0.0, RELATIVE_NOISE * x) if measure.key == "ate_percent" else measure.noise or 0.0
    return (x - y) * measure.sign > noise


def draw(a: Mapping[str, Values], b: Mapping[str, Values], kind: str) -> bytes:
    """A panel per measure: B - A of every sequence as a bar, orange where B is better; `kind` is "svg" or "png"."""
    names = sorted(set(a) & set(b))
    columns = 4
    with figure((3.2 * columns, 2 * (0.22 * max(len(names), 4) + 1.1)), kind) as (fig, done):
        for k, measure in enumerate(MEASURES):
            axes = fig.add_subplot(2, columns, k + 1)
            changes = differences(a, b, measure)
            shown = [changes.get(name, 0.0) for name in names]
            colours = [COLOURS["ours"] if change * measure.sign > 0 else OTHERS[0] for change in shown]
            axes.barh(names, shown, color=colours)
            for row, name in enumerate(names):
                if name not in changes:
                    axes.text(0, row, " n/a", va="center", fontsize=8)
            axes.axvline(0, color="#1a1a1a", lw=0.8)
            axes.invert_yaxis()
            axes.set_title(f"{measure.label} ({measure.unit})", fontsize=10)
            axes.tick_params(labelsize=8, labelleft=k % columns == 0)
        fig.supxlabel("B - A; orange: B is better, blue: worse", fontsize=9)
    return done.getvalue()


def main() -> None:
    """Print the comparison; exit code 2 and one line if a folder is not a run, 1 if B loses and must not."""
    parser = argparse.ArgumentParser(prog="python -m stages.comparisons.compare", description=__doc__)
    parser.add_argument("a", type=Path, metavar="A", help="result folder of one run, results/<dataset>")
    parser.add_argument("b", type=Path, metavar="B", help="result folder of the other run")
    parser.add_argument("--figure", type=Path, help="where to draw it: a .png or .svg file (default: nowhere)")
    parser.add_argument("--no-loss", action="store_true", help="exit code 1 where B is worse beyond the noise")
    arguments = parser.parse_args()
    try:
        kind = arguments.figure.suffix[1:].lower() if arguments.figure else "png"
        if kind not in ("png", "svg"):
            raise InputError(arguments.figure, "a .png or .svg file", f"'.{kind}'", "name the figure so")
        a, b = read_run(arguments.a), read_run(arguments.b)
        if arguments.figure:
            with atomic(arguments.figure) as partial:
                partial.write_bytes(draw(a, b, kind))
        print(f"A: {arguments.a}\nB: {arguments.b}\n{describe(a, b)}")
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    if arguments.no_loss:
        lost = losses(a, b)
        print("", *(lost or ["B loses nowhere beyond the noise"]), sep="\n")
        sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
