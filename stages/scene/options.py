"""Options of the decision which effects a scene needs."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from stages.shared.split import SplitOptions


def _from_yaml(value: object) -> object:
    """YAML 1.1 reads an unquoted yes or no as a boolean."""
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value


Choice = Annotated[Literal["auto", "yes", "no"], BeforeValidator(_from_yaml)]


class SceneOptions(SplitOptions):
    """Which effects the reconstruction models: auto decides from evidence, yes and no overrule it."""

    dynamic: Choice = Field("auto", description="moving parts: control points and skinning")
    rotation_only: Choice = Field(
        "auto", description="a camera that only turns; stated in the report, poses do not follow it"
    )
    exposure: Choice = Field("auto", description="brightness that changes over time: a gain per frame")
    view_dependent: Choice = Field("auto", description="colours that change with the view: spherical harmonics")
    non_rigid: Choice = Field("auto", description="non-rigid movers: more control points, weaker rigidity")
