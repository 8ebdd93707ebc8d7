"""What the estimation takes, and what it finds."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stages.ba import shutter
from stages.ba.graph import FlowGraph
from stages.ba.guesses import PoseGuess
from stages.ba.state import State, Step
from stages.ba.zoom import NOT_TESTED, Evidence


@dataclass(frozen=True)
class Problem:
    """Input of the estimation: masked observations and prior knowledge.

    Attributes:
        graph: masked observations.
        masked: whether masks were used, or poses of an earlier round that was solved with masks.
        known_focal_px: the focal length on the flow grid, if it is given.
        previous: the solution of the previous round, or given poses to start from.
        unmasked: the same observations without masks, as a fallback.
        iterations: largest number of iterations of the refinement at each robust scale.
    """

    graph: FlowGraph
    masked: bool
    known_focal_px: float | None = None
    previous: PoseGuess | None = None
    unmasked: FlowGraph | None = None
    iterations: int = 15


@dataclass(frozen=True)
class Focal:
    """The decision about the focal length: "estimated", "weakly observed", "held at prior" or "known".

    `relative_sigma` is the predicted relative error of estimating it; `reason` says why it was held; `prior_sides`, in
    longer sides of the image, is where a `border_path` has moved the centre of its prior to.
    """

    decision: str
    relative_sigma: float | None
    reason: str = ""
    prior_sides: float | None = None


@dataclass(frozen=True)
class Estimate:
    """A solution with its diagnostics.

    Attributes:
        camera: "moving", "near-still", "rotating" or "failed".
        covariance: [T, 6, 6] of the left twists, in the gauge of the state.
        residual_px: median reprojection error of the confident static matches.
        focal: the decision about the focal length and its numbers.
        failed_checks: checks of the statistics that the solution failed, in words; flags: these and other warnings.
        static: [T, height, width] 0 or 1, the static area used instead of the input masks; None: the masks were kept.
        zoom: the decision whether the focal length changes over the frames.
        rolling: the decision whether rows are exposed one after the other.
    """

    state: State
    camera: str
    covariance: np.ndarray
    residual_px: float
    focal: dict[str, Any]
    statistics: dict[str, Any]
    failed_checks: list[str] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    static: np.ndarray | None = None
    zoom: Evidence = NOT_TESTED
    rolling: shutter.Evidence = shutter.NOT_TESTED
