"""Published numbers of other methods, listed with ours only where the data are the same."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from stages.shared.tables import Column, Row, Table

METRICS = ("ate", "rpe_trans", "rpe_rot_deg")
ABOUT = (Column("source", "source"), Column("notes", "note", long=True))


def pose_table(numbers: Mapping[str, Any], rows: Sequence[Row]) -> Table:
    """Published pose errors, with our means among them only if all 14 Sintel sequences were run."""
    published = numbers["poses"]
    wanted = set(numbers["sintel_sequences"])
    here = [row for row in rows if row["sequence"] in wanted]
    measured = [_measured(method, here, len(wanted)) for method in dict.fromkeys(row["method"] for row in here)]
    columns = (
        *(
            Column("method", "method"),
            Column("ate", "ATE", "scene units", 3),
            Column("rpe_trans", "RPE", "scene units", 3),
        ),
        *(Column("rpe_rot_deg", "RPE", "degrees", 3), *ABOUT),
    )
    found = len({row["sequence"] for row in here})
    if found < len(wanted):
        title = f"Published: {published['title']} (not the same data)"
        relation = f"Not the same data as this report, which holds {found} of these 14 sequences"
        return Table("published_poses", title, f"{relation}. {published['protocol']}.", columns, published["rows"])
    listed = sorted([*measured, *published["rows"]], key=lambda row: math.inf if row["ate"] is None else row["ate"])
    title = f"Published: {published['title']}"
    return Table("published_poses", title, f"The same 14 sequences. {published['protocol']}.", columns, listed)


def _measured(method: str, rows: Sequence[Row], wanted: int) -> Row:
    """The mean of a method of this report over the sequences; without numbers if any sequence is not scored."""
    own = [row for row in rows if row["method"] == method]
    scored = [row for row in own if row["status"] == "ok"]
    about = {"method": method, "source": "this report"}
    if len(scored) < wanted:
        nothing = dict.fromkeys(METRICS)
        return {**about, **nothing, "notes": f"no mean: {len(scored)} of the {wanted} sequences are scored"}
    means = {key: sum(row[key] for row in scored) / len(scored) for key in METRICS}
    return {**about, **means, "notes": f"mean over the same {wanted} sequences"}


def image_table(numbers: Mapping[str, Any]) -> Table:
    """Published image scores, which are on other data than ours."""
    published = numbers["images"]
    columns = (
        *(Column("method", "method"), Column("psnr_db", "PSNR", "dB", 1), Column("ms_ssim", "MS-SSIM", "0..1", 3)),
        *(Column("time", "time"), Column("size_mb", "model", "MB", 0), *ABOUT),
    )
    note = f"Not the same data as this report. {published['protocol']}."
    title = f"Published: {published['title']} (not the same data)"
    return Table("published_images", title, note, columns, published["rows"])
