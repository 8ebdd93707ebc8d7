"""Numbers of other papers beside ours, only where the data are the same."""

from collections.abc import Mapping, Sequence
from typing import Any

from stages.eval.tables import Column, Row, Table

ABOUT = (Column("source", "source"), Column("notes", "note", long=True))


def pose_table(numbers: Mapping[str, Any], rows: Sequence[Row]) -> Table:
    """Published pose errors, with our mean in its place only if all 14 Sintel sequences are here and scored."""
    published = numbers["poses"]
    wanted = set(numbers["sintel_sequences"])
    scored = [row for row in rows if row["sequence"] in wanted and row["method"] == "ours" and row["status"] == "ok"]
    columns = (
        *(
            Column("method", "method"),
            Column("ate", "ATE", "scene units", 3),
            Column("rpe_trans", "RPE", "scene units", 3),
        ),
        *(Column("rpe_rot_deg", "RPE", "degrees", 3), *ABOUT),
    )
    if len(scored) < len(wanted):
        title = f"Published: {published['title']} (not the same data)"
        relation = f"Not the same data as this report, which scored {len(scored)} of these 14 sequences"
        return Table("published_poses", title, f"{relation}. {published['protocol']}.", columns, published["rows"])
    metrics = ("ate", "rpe_trans", "rpe_rot_deg")
    mean = {key: sum(row[key] for row in scored) / len(scored) for key in metrics}
    ours = {"method": "ours", **mean, "source": "this report", "notes": "mean over the same 14 sequences"}
    listed = sorted([ours, *published["rows"]], key=lambda row: row["ate"])
    title = f"Published: {published['title']}"
    return Table("published_poses", title, f"The same 14 sequences. {published['protocol']}.", columns, listed)


def image_table(numbers: Mapping[str, Any]) -> Table:
    """Published image scores; never the same data as ours."""
    published = numbers["images"]
    columns = (
        *(Column("method", "method"), Column("psnr_db", "PSNR", "dB", 1), Column("ms_ssim", "MS-SSIM", "0..1", 3)),
        *(Column("time", "time"), Column("size_mb", "model", "MB", 0), *ABOUT),
    )
    note = f"Not the same data as this report. {published['protocol']}."
    title = f"Published: {published['title']} (not the same data)"
    return Table("published_images", title, note, columns, published["rows"])
