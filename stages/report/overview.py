"""The beginning of the report: one sentence, headline figures, failures; and the groups of tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stages.evaluate import pose_diagnostics, pose_statistics, ratios, score_models, summaries
from stages.evaluate.costs import is_ours
from stages.evaluate.score_masks import PRIOR
from stages.report import detail_tables, published
from stages.report.figures import Figure
from stages.shared.run_inputs import taken_by
from stages.shared.tables import Row, Table, decimal

Rows = Mapping[str, list[Row]]


@dataclass(frozen=True)
class Tile:
    """One headline figure."""

    label: str
    value: str
    unit: str
    note: str


@dataclass(frozen=True)
class Group:
    """Tables and charts on one subject.

    Attributes:
        name: key of TEXTS. tables: shown. more: shown collapsed. sentence: a summary, or "".
    """

    name: str
    title: str
    tables: list[Table]
    more: list[Table]
    figures: list[Figure] = field(default_factory=list)
    sentence: str = ""

    @property
    def text(self) -> str:
        """The introduction of the group."""
        return TEXTS[self.name]


TEXTS = {
    "poses": "How far the estimated cameras are from the true ones. COLMAP ran on the same frames on the same machine.",
    "images": "How well renders match frames. Images of held-out frames are used neither for training nor for the "
    "choice of effects and control points; their poses, flow and masks are: these were estimated from all frames. "
    "Interpolation between the neighbours of a held-out frame, without a scene model, is the baseline.",
    "masks": "How well the pixels labelled dynamic match those that truly move. Masks are named by their source.",
    "checks": "How well poses and depth explain the optical flow (needs no truth), flow and depth against truth, "
    "how well control points explain the tracks of moving pixels, and what the model takes on disk.",
    "time": "Time and memory of every stage, from the start of its process to the end.",
    "tradeoff": "The same sequences under other settings. One point per setting: error against time.",
    "growth": "Time and memory of every stage while one size grows.",
    "effects": "Only effects for which a scene gives evidence are modelled; the others cost nothing.",
}


def build_groups(rows: Rows, protocols: Mapping[str, str], numbers: Mapping[str, Any]) -> list[Group]:
    """The groups of tables; for several sequences the means are shown and the tables of all sequences collapsed.

    Args:
        rows, protocols: by kind of table. numbers: published numbers of other methods.
    """
    poses_mean, poses = detail_tables.pose_tables(rows["poses"], protocols["poses"])
    images_mean, images = detail_tables.image_tables(rows["images"], protocols["images"])
    masks_mean, masks = detail_tables.mask_tables(rows["masks"], protocols["masks"])
    time_mean, time = detail_tables.time_tables(rows["time"])
    checks_mean, checks = detail_tables.check_tables(rows["checks"])
    effects = [detail_tables.decision_table(rows["decisions"]), detail_tables.simulation_table(rows["simulation"])]
    decided = pose_diagnostics.decision_table(rows["poses"])
    statistics = pose_statistics.statistics_table(rows["statistics"])
    compared = ratios.ratio_table(rows["poses"], rows["settings"])
    other_poses, other_images = published.pose_table(numbers, rows["poses"]), published.image_table(numbers)
    many = len({row["sequence"] for row in rows["time"]}) > 1
    more_poses = [*([poses] if many else []), statistics, other_poses]
    groups = [
        Group("poses", "Camera poses", [poses_mean if many else poses, decided, compared], more_poses),
        Group("images", "Images", [images_mean] if many else [images], [*([images] if many else []), other_images]),
        Group("masks", "Masks", [masks_mean] if many else [masks], [masks] if many else []),
        Group("checks", "Flow, depth, motion and size", [checks_mean] if many else [checks], [checks] if many else []),
        Group("time", "Time and memory", [time_mean], [time] if many else []),
        Group("effects", "Effects", [] if many else effects, effects if many else []),
    ]
    taken = taken_by(row for row in rows["poses"] if row["method"] == "ours")
    return [_labelled(_without_empty(group), taken) for group in groups]


def _without_empty(group: Group) -> Group:
    tables, more = ([table for table in part if table.rows] for part in (group.tables, group.more))
    return replace(group, tables=tables, more=more)


def _labelled(group: Group, taken: str) -> Group:
    """The group with the inputs that were not estimated in the title of each table that holds our numbers."""
    if not taken:
        return group

    def titled(table: Table) -> Table:
        ours = not table.name.startswith(("published", "simulation"))
        return replace(table, title=f"{table.title} (not estimated: {taken})") if ours else table

    return replace(group, tables=[titled(table) for table in group.tables], more=[titled(t) for t in group.more])


def outdated(group: Group, changes: Sequence[str]) -> Group:
    """The group of an earlier comparison, labelled as outdated if there are `changes` since; otherwise unchanged."""
    if not changes:
        return group
    sentence = f"Made under other options or code than the results above: {'; '.join(changes)}. {group.sentence}"
    label = "made under other options"
    return replace(
        group,
        sentence=sentence.strip(),
        title=f"{group.title} ({label})",
        tables=[replace(table, title=f"{table.title} ({label})") for table in group.tables],
        more=[replace(table, title=f"{table.title} ({label})") for table in group.more],
        figures=[replace(figure, title=f"{figure.title} ({label})") for figure in group.figures],
    )


def tiles(rows: Rows) -> list[Tile]:
    """Headline figures of our method: means over sequences, each with the number of these."""
    ours = _mean(summaries.pose_means(rows["poses"]), method="ours")
    test = summaries.image_means(rows["images"])
    image = _mean(test, split="test", region="whole", method="ours")
    copies = [row for row in test if (row["split"], row["region"]) == ("test", "whole") and row["method"] != "ours"]
    copied = max(copies, key=lambda row: (row["n"], row["psnr_db"]), default=None)
    masks = summaries.mask_means(rows["masks"])
    mask = next((row for row in reversed(masks) if row["method"] != PRIOR), None)
    own = [row for row in rows["time"] if is_ours(row)]
    seconds, peak_mb = _per_sequence(own, "wall_s", sum), _per_sequence(own, "peak_mb", max)
    rivals = [row for row in summaries.pose_means(rows["poses"]) if _rival(row)]
    best = min(rivals, key=lambda row: (-row["n"], row["ate_percent"]), default=None)
    against = f"best {best['method']}: {decimal(best['ate_percent'], 2)} %, n = {best['n']}" if best else "COLMAP: none"
    copied_words = f"{copied['method']}: {copied['psnr_db']:.1f} dB, n = {copied['n']}" if copied else ""
    cpu_s = f"; {np.mean(_per_sequence(own, 'cpu_s', sum)):.0f} s of CPU" if seconds else ""
    most = f"largest of all stages; n = {len(peak_mb)}"
    threads = f", at most {most_threads} threads" if (most_threads := _most_threads(own)) else ""
    spent = f"per sequence, without COLMAP{threads}{cpu_s}; n = {len(seconds)}"
    return [
        Tile("Camera error (ATE)", _show(ours, "ate_percent", 2), "% of path", f"{_scored(ours)}; {against}"),
        Tile("Focal error", _show(ours, "focal_abs_percent", 1), "%", _scored(ours)),
        Tile(
            "Held-out PSNR", _show(image, "psnr_db", 1), "dB", "; ".join(filter(None, [_scored(image), copied_words]))
        ),
        Tile("Mask IoU", _show(mask, "iou", 2), "", f"{mask['method']}; {_scored(mask)}" if mask else "no truth"),
        Tile("Time", f"{np.mean(seconds):.0f}" if seconds else "n/a", "s", spent),
        Tile("Peak memory", f"{max(peak_mb):.0f}" if peak_mb else "n/a", "MB", most),
    ]


def summary(rows: Rows) -> str:
    """The report in one sentence."""
    values = {tile.label: f"{tile.value} {tile.unit}".strip() for tile in tiles(rows)}
    names = {row["sequence"] for row in rows["time"]}
    taken = taken_by(row for row in rows["poses"] if row["method"] == "ours")
    failed = {row["sequence"] for row in rows["poses"] if row["method"] == "ours" and not row["registered"]}
    counted = f"{len(names)} sequence{'s' if len(names) != 1 else ''}" + (f", with {taken}" if taken else "")
    counted += f" ({len(failed)} of them without cameras)" if failed else ""
    return (
        f"{counted}: cameras off by {values['Camera error (ATE)']}, "
        f"held-out views at {values['Held-out PSNR']}, masks at IoU {values['Mask IoU']}, "
        f"in {values['Time']} per sequence."
    )


def problems(rows: Rows, names: Sequence[str]) -> list[str]:
    """Failures and missing results, one sentence each."""
    scored = {row["sequence"] for row in rows["poses"]}
    taken = taken_by(row for row in rows["poses"] if row["method"] == "ours")
    told = f"Not estimated: {taken}. This affects every result of ours."
    found = [told] if taken else []
    found += [f"{name}: not evaluated; it counts as failed." for name in names if name not in scored]
    for row in rows["poses"]:
        if row["status"] in ("partial", "failed"):
            found.append(f"{row['sequence']}, {row['method']}: {row['status']} ({row['note']}).")
    degenerate = {row["sequence"]: row for row in rows["poses"] if row["status"].startswith("degenerate truth")}
    found += [f"{name}: {row['status']} ({row['note']})." for name, row in degenerate.items()]
    for name in names:
        # A round without any pose says why in its row.
        own = [row for row in rows["poses"] if row["sequence"] == name and row["registered"]]
        if warned := pose_diagnostics.warnings_by_round(own):
            found.append(f"{name}: warnings of the bundle adjustment. {warned}")
    found += score_models.stuck_fits(rows["checks"])
    blind = sorted({row["sequence"] for row in rows["poses"] if row["status"] == "no truth"})
    if blind:
        found.append(f"No camera truth, hence no ATE or RPE: {', '.join(blind)}. See the checks without truth.")
    return found


def _mean(rows: Sequence[Row], **wanted: str) -> Row | None:
    return next((row for row in rows if all(row[key] == value for key, value in wanted.items())), None)


def _rival(row: Row) -> bool:
    return str(row["method"]).startswith("COLMAP") and row["ate_percent"] is not None


def _per_sequence(rows: Sequence[Row], key: str, combine: Callable[[list[float]], float]) -> list[float]:
    groups: dict[str, list[float]] = {}
    for row in rows:
        groups.setdefault(row["sequence"], []).append(row[key])
    return [combine(values) for values in groups.values()]


def _most_threads(rows: Sequence[Row]) -> int:
    return max((row["threads"] for row in rows), default=0)


def _show(row: Row | None, key: str, digits: int) -> str:
    return decimal(row[key], digits) if row and row[key] is not None else "n/a"


def _scored(row: Row | None) -> str:
    return f"n = {row['n']} of {row['sequences']} sequences" if row else "no truth"
