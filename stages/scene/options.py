"""Options of the decision which effects a scene needs."""

from typing import Annotated, Literal

from pydantic import Field

from stages.shared.split import SplitOptions

Choice = Literal["auto", "yes", "no"]


class SceneOptions(SplitOptions):
    """Which effects the reconstruction models: auto decides from evidence, yes and no overrule it."""

    dynamic: Choice = Field("auto", description="moving parts: control points and skinning")
    rotation_only: Choice = Field(
        "auto", description="a camera that only turns; stated in the report, poses do not follow it"
    )
    exposure: Choice = Field(
        "auto",
        description="brightness that changes over time: a gain per frame; no rules out gains per channel too, unless"
        " white_balance is yes",
    )
    white_balance: Choice = Field("auto", description="tint that changes over time: a gain per channel and frame")
    atmosphere: Choice = Field(
        "auto",
        description="fog and haze: extinction and airlight between camera and surfaces; yes models none in clear air",
    )
    view_dependent: Choice = Field(
        "auto",
        description="colours that change with the view: spherical harmonics; auto: not below 0.5 degrees of views",
    )
    moving_shadows: Choice = Field(
        "auto", description="light that changes from place to place and over time, as where shadows of movers pass"
    )
    non_rigid: Choice = Field("auto", description="non-rigid movers: more control points, weaker rigidity")
    motion_blur: Choice = Field("auto", description="frames that are averaged while the shutter is open")
    shutter: Literal["auto"] | Annotated[float, Field(gt=0, le=1)] = Field(
        "auto", description="how long the shutter is open for a frame, in frames; auto: measured"
    )
