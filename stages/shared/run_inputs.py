"""Inputs of a run, read from its artifacts: its masks, and what it took from ground truth instead of estimating it."""

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
"""Names of masks, by `segment.source`."""
TRUTH = "truth"
WITH_MASKS = ", with "
"""Separates the name of a variant of the baseline from the name of its masks."""


@dataclass(frozen=True)
class RunInputs:
    """Inputs of one run.

    Attributes:
        masks: name of its masks, one of the values of `MASKS`.
        truth: inputs taken from ground truth, as in "true flow, true depth"; None if it used the frames alone.
        masked_from: the first round whose poses were solved with masks.
    """

    masks: str
    truth: str | None = None
    masked_from: int = 1

    def masks_in(self, number: int) -> str:
        """Name of the masks of a round, 1, 2, ..."""
        return self.masks if number >= self.masked_from else MASKS["none"]


def read_run_inputs(flow: Path, masks: Sequence[Path], poses: Sequence[Path]) -> RunInputs:
    """The inputs of a run, from its artifacts.

    Args:
        flow: flow/pairs.arrow.
        masks, poses: folders of masks and ba/poses.parquet of every round; the first round may have no masks.
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
    return RunInputs(MASKS[source], truth, len(poses) - len(masks) + 1)


def mask_source(masks: Path) -> str:
    """The `segment.source` that a folder of masks was made with."""
    return str(read_json(masks / "masks.json")["options"]["source"])


def truth_used_by(rows: Iterable[Row]) -> str:
    """All inputs that our rows took from ground truth, in words; "" if they used the frames alone."""
    return "; ".join(dict.fromkeys(row["from_truth"] for row in rows if row.get("from_truth")))
