"""Options of the dynamic control points."""

from typing import Annotated, Literal

from pydantic import Field

from stages.shared.options import MAX_SEED
from stages.shared.split import SplitOptions


class ControlOptions(SplitOptions):
    """Control points and their motion (stage 1)."""

    control_points: Literal["auto"] | Annotated[int, Field(ge=1, le=4096)] = Field(
        "auto", description="number of control points; auto: 1000, or as many as there are tracks"
    )
    added_share: float = Field(
        0, ge=0, le=0.9, description="share of the control points that is added halfway, where the gradient is high"
    )
    region: Literal["dynamic", "whole"] = Field(
        "dynamic", description="pixels that control points cover: the masked ones, or all"
    )
    model: Literal["table", "mlp"] = Field(
        "table",
        description="motion model: rigid motions per point and frame with splines, or the network distilled from them",
    )
    arap: Literal["auto"] | Annotated[float, Field(ge=0, le=10)] = Field(
        "auto", description="weight of rigidity in both stages; auto: small, larger where the tracks are noisy; 0: off"
    )
    steps: int = Field(600, ge=0, le=20000, description="optimisation steps of stage 1")
    learning_rate: float = Field(0.002, gt=0, le=1, description="Adam's step for the motion, in extents of the points")
    track_stride_px: int = Field(2, ge=1, le=16, description="pixels of the flow grid between neighbouring tracks")
    time_frequencies: int = Field(2, ge=0, le=4, description="frequencies of the network's time encoding; more overfit")
    width: int = Field(128, ge=8, le=1024, description="neurons per layer of the network")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of sampling and initial weights")
