"""What a run took from the truth instead of estimating it, and whose masks it used, as its artifacts say."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.shared.artifacts import read_json, read_metadata
from stages.shared.tables import Row

MASKS = {
    "refined": "refined masks",
    "prior": "prior above one half",
    "none": "no masks",
    "truth": "true motion masks",
}
"""What masks are called, by `segment.source`."""
TRUTH = "truth"
WITH_MASKS = ", with "
"""What stands between a variant of the baseline and the masks that it had."""


@dataclass(frozen=True)
class Given:
    """What one run was given.

    Attributes:
        masks: what its masks are called, one of `MASKS`.
        truth: what it took from the truth, as in "true flow, true depth"; None if it had the frames alone.
        masked_from: the first round whose poses had masks.
    """

    masks: str
    truth: str | None = None
    masked_from: int = 1

    def masks_in(self, number: int) -> str:
        """What the masks of a round, 1, 2, ..., are called."""
        return self.masks if number >= self.masked_from else MASKS["none"]


def read_given(flow: Path, masks: Sequence[Path], poses: Sequence[Path]) -> Given:
    """What a run was given.

    Args:
        flow: flow/pairs.arrow.
        masks, poses: folders of masks and ba/poses.parquet of every round; the first may have gone without masks.
    """
    source, adjusted = mask_source(masks[-1]), read_metadata(poses[-1])["options"]
    cameras = adjusted["poses_from"] == TRUTH
    taken = {
        "true flow": read_metadata(flow)["source"] == TRUTH,
        "true masks": source == TRUTH,
        "true intrinsics": adjusted["intrinsics"] == TRUTH or cameras,
        "true poses": cameras,
        "true depth": adjusted["depth_from"] == TRUTH,
    }
    truth = ", ".join(name for name, was in taken.items() if was) or None
    return Given(MASKS[source], truth, len(poses) - len(masks) + 1)


def mask_source(masks: Path) -> str:
    """The `segment.source` that a folder of masks was made with."""
    return str(read_json(masks / "masks.json")["options"]["source"])


def given_truth(rows: Iterable[Row]) -> str:
    """All truth that rows of ours were given, in words; "" if they had the frames alone."""
    return "; ".join(dict.fromkeys(row["given"] for row in rows if row.get("given")))
