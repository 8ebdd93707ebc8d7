"""Inputs of a run, read from its artifacts: its masks, and what it took instead of estimating it, from whom."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from stages.shared.artifacts import read_json, read_metadata
from stages.shared.tables import Row

MASKS = {
    "refined": "refined masks",
    "prior": "prior above one half",
    "none": "no masks",
    "truth": "true motion masks",
}
"""Names of masks, by `segment.source`; any other source is the path of masks that the user handed in."""
GIVEN_MASKS = "given masks"
PRIOR_MASKS = ("refined", "prior")
"""Sources of masks that are made from the motion prior."""
ESTIMATED_MASKS = (*PRIOR_MASKS, "none")
"""Sources of masks that take nothing but the frames."""
ESTIMATE, TRUTH = "estimate", "truth"
WITH_MASKS = ", with "
"""Separates the name of a variant of the baseline from the name of its masks."""


class Taken(NamedTuple):
    """Something that a run took instead of estimating it.

    Attributes:
        what: it, in words, as in "depth".
        origin: where from: "truth", or the path that the user named.
        about: what else is to be said of it, or "".
    """

    what: str
    origin: str
    about: str = ""

    @property
    def name(self) -> str:
        """As in "true depth" or "given depth"."""
        return f"{'true' if self.origin == TRUTH else 'given'} {self.what}"


@dataclass(frozen=True)
class RunInputs:
    """Inputs of one run.

    Attributes:
        masks: name of its masks, one of the values of `MASKS` or GIVEN_MASKS.
        taken: what it took from ground truth or from the user, as in "true flow, given depth"; None if it used the
            frames alone.
        masked_from: the first round whose poses were solved with masks.
    """

    masks: str
    taken: str | None = None
    masked_from: int = 1

    def masks_in(self, number: int) -> str:
        """Name of the masks of a round, 1, 2, ..."""
        return self.masks if number >= self.masked_from else MASKS["none"]


def read_run_inputs(flow: Path, masks: Sequence[Path], poses: Sequence[Path]) -> RunInputs:
    """The inputs of a run, from its artifacts.

    Args:
        flow: flow/pairs.arrow.
        masks, poses: folders of masks and ba/poses.parquet of every round; the first round may have no masks, and masks
            that are not estimated are the same in all rounds.
    """
    source = mask_source(masks[-1])
    taken = ", ".join(found.name for found in taken_inputs(flow, masks[-1], poses[-1])) or None
    masked_from = len(poses) - len(masks) + 1 if source in PRIOR_MASKS else 1
    return RunInputs(mask_name(source), taken, masked_from)


def taken_inputs(flow: Path, masks: Path, poses: Path) -> list[Taken]:
    """Everything that a run took from ground truth or from the user, from the artifacts of its last round.

    The one list of them: marks in tables and the first screen of the report follow it.
    """
    return [found for found in _candidates(flow, masks, poses) if found.origin]


def _candidates(flow: Path, masks: Path, poses: Path) -> Iterator[Taken]:
    """As `taken_inputs`, with an empty origin for what was estimated."""
    matched, segmented, adjusted = read_metadata(flow), read_json(masks / "masks.json"), read_metadata(poses)
    options = adjusted["options"]
    cameras = _origin(options["poses_from"], ESTIMATE)
    yield Taken("flow", _origin(matched["source"], "dis"), matched.get("given", ""))
    yield Taken("masks", _origin(segmented["options"]["source"], *ESTIMATED_MASKS), segmented.get("given", ""))
    evidence = segmented["options"].get("evidence") if segmented["options"]["source"] == "refined" else None
    yield Taken("masks as evidence", evidence or "")
    yield Taken("intrinsics", TRUTH if cameras == TRUTH else _origin(options["intrinsics"], ESTIMATE))
    yield Taken("poses", cameras)
    yield Taken("depth", _origin(options["depth_from"], ESTIMATE), adjusted.get("given_depth", ""))


def _origin(source: Any, *estimates: str) -> str:
    return "" if source in estimates else str(source)


def given_in_words(name: str, taken: Iterable[Taken]) -> str:
    """What the user handed in for the sequence of this name, as in "masks (/data/clip: binary)"; "" if nothing."""
    given = [found for found in taken if found.origin != TRUTH]
    places = [found.origin.replace("{sequence}", name) + (f": {found.about}" if found.about else "") for found in given]
    return ", ".join(f"{found.what} ({place})" for found, place in zip(given, places, strict=True))


def mask_source(masks: Path) -> str:
    """The `segment.source` that a folder of masks was made with."""
    return str(read_json(masks / "masks.json")["options"]["source"])


def mask_name(source: str) -> str:
    """The name of masks by their `segment.source`."""
    return MASKS.get(source, GIVEN_MASKS)


def taken_by(rows: Iterable[Row]) -> str:
    """All that our rows took from ground truth or from the user, in words; "" if they used the frames alone."""
    return "; ".join(dict.fromkeys(row["taken"] for row in rows if row.get("taken")))
