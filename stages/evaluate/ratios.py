"""Ratio of our camera error to that of COLMAP and to that of the same pipeline with true masks, per sequence."""

import json
from collections.abc import Sequence

from stages.shared.run_inputs import WITH_MASKS
from stages.shared.tables import Column, Row, Table

TRUE_MASKS = {"segment.source": "truth"}
"""The only option in which the run with true masks differs from the configured one."""
MAX_RATIO = 1.5
"""With good masks, the error is at most this many times the error with true masks."""
COLUMNS = (
    Column("sequence", "sequence"),
    Column("ate_percent", "ours", "ATE, % of path", 3),
    Column("colmap_percent", "best COLMAP", "ATE, % of path", 3),
    Column("colmap", "variant of COLMAP"),
    Column("colmap_ratio", "ours / COLMAP", "ratio", 2),
    Column("true_masks_percent", "ours, true masks", "ATE, % of path", 3),
    Column("true_masks_ratio", "ours / true masks", "ratio", 2),
)


def ratio_table(poses: Sequence[Row], settings: Sequence[Row]) -> Table:
    """A row per sequence whose true path defines an ATE, with the counts as its note; none without a comparison.

    Args:
        poses: rows of the pose table. Of COLMAP's variants the complete one of lowest ATE counts, among those that
            see the frames without masks.
        settings: rows of the sweep's table.
    """
    scored = [row for row in poses if row["method"] == "ours" and row["status"] in ("ok", "partial", "failed")]
    rows = [_row(row, poses, settings) for row in scored]
    compared = [row for row in rows if row["colmap"] or row["true_masks_percent"] is not None]
    return Table("ratios", "Camera error against COLMAP and against true masks", counts(compared), COLUMNS, compared)


def counts(rows: Sequence[Row]) -> str:
    """On how many sequences our error is below COLMAP's best, and at most MAX_RATIO times that with true masks.

    A method without a complete path loses on that sequence.
    """
    found = []
    rivals = [row for row in rows if row["colmap"]]
    if rivals:
        alone = sum(row["ate_percent"] is not None and row["colmap_percent"] is None for row in rivals)
        lower = alone + sum(row["colmap_ratio"] is not None and row["colmap_ratio"] < 1 for row in rivals)
        missing = f" ({alone} of these: COLMAP has no complete path)" if alone else ""
        found.append(f"Lower than the best of COLMAP without masks on {lower} of {len(rivals)} sequences{missing}.")
    masked = [row for row in rows if row["true_masks_percent"] is not None]
    if masked:
        near = sum(row["true_masks_ratio"] is not None and row["true_masks_ratio"] <= MAX_RATIO for row in masked)
        found.append(f"At most {MAX_RATIO:g} times the error with true masks on {near} of {len(masked)} sequences.")
    return " ".join(found)


def _row(ours: Row, poses: Sequence[Row], settings: Sequence[Row]) -> Row:
    name, error = ours["sequence"], _complete_error(ours)
    rivals = plain_rivals(poses, name)
    best = best_rival([row for row in rivals if row["status"] == "ok"])
    true_masks = next((r for r in settings if r["sequence"] == name and json.loads(r["overrides"]) == TRUE_MASKS), None)
    row: Row = {"sequence": name, "ate_percent": error}
    row["colmap"] = best["method"] if best else "none complete" if rivals else None
    for key, other in (("colmap", _complete_error(best)), ("true_masks", _complete_error(true_masks))):
        row[f"{key}_percent"] = other
        row[f"{key}_ratio"] = error / other if error is not None and other else None
    return row


def _complete_error(row: Row | None) -> float | None:
    return row["ate_percent"] if row and row["status"] == "ok" else None


def plain_rivals(poses: Sequence[Row], sequence: str) -> list[Row]:
    """The rows of COLMAP's variants that see the frames of a sequence without masks."""
    rows = [row for row in poses if row["sequence"] == sequence and row["method"].startswith("COLMAP")]
    return [row for row in rows if WITH_MASKS not in row["method"]]


def best_rival(rivals: Sequence[Row]) -> Row | None:
    """The complete one of lowest ATE, or of lowest rotation error where the truth defines no ATE."""
    complete = [row for row in rivals if row["status"] not in ("failed", "partial")]
    key = "rpe_rot_deg" if all(row["ate_percent"] is None for row in complete) else "ate_percent"
    return min((row for row in complete if row[key] is not None), key=lambda row: row[key], default=None)
