"""The whole configuration: one section per stage and shared keys at the top level, checked before any work."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, field_validator

from stages.ba.options import BAOptions
from stages.colmap.options import ColmapOptions
from stages.configuration.comparison_options import ScalingOptions, SweepOptions
from stages.configuration.presets import FIXED_ALL, FIXED_POSES, PRESETS, Preset, override, value_of
from stages.configuration.shots import Stated, read_option
from stages.control.options import ControlOptions
from stages.evaluate.options import EvaluateOptions
from stages.export.options import ExportOptions
from stages.flow.options import FlowOptions
from stages.gaussians.options import GaussiansOptions
from stages.given.intrinsics import ESTIMATE, TRUTH, IntrinsicsOption
from stages.inspect.options import InspectOptions
from stages.lens.options import LensOptions
from stages.motion.options import MotionOptions
from stages.render.options import RenderOptions
from stages.report.options import ReportOptions
from stages.scene.options import SceneOptions
from stages.segment.options import SegmentOptions
from stages.shared.errors import OptionError
from stages.shared.options import MAX_SEED, Options, to_flags, validate
from stages.simulate.options import SimulateOptions
from stages.video.options import VideoOptions

SIMULATED = "simulated"
"""The dataset of the scenes that the simulator renders."""


class Config(Options):
    """config.yaml. Keys that several stages share are at the top level; a section may override them."""

    dataset: str = Field(
        SIMULATED, description="'simulated', a video, or a folder: MPI-Sintel, frame folders, frames, videos"
    )
    scenes: Literal["all", "tuned", "test"] | list[str] = Field(
        ["demo"], description="if simulated: library scenes or YAML files to render; or all, tuned or test ones"
    )
    pass_: Literal["clean", "final"] = Field("final", alias="pass", description="which MPI-Sintel pass to read")
    sequences: Literal["all"] | list[str] = Field("all", description="'all' or a list of names within the dataset")
    shots: Stated | dict[str, Stated] = Field(
        "auto",
        description="shots of a clip, each a sequence of its own: auto: find the cuts; no: the clip is one shot; or "
        "the first and last frame of each, as in [[1, 40], [41, 90]]; or one of these for each clip by its name",
    )
    preset: Preset = Field("balanced", description="fast, balanced or accurate; your own values win over the preset's")
    keep_flow: bool = Field(
        True,
        description="keep the flow, about half of a sequence's disk; false: remove it once all that reads it has run",
    )
    rounds: int = Field(
        4,
        ge=1,
        le=5,
        description="how often motion, masks and poses are estimated in turn; from the third on poses only where "
        "masks have changed, from the fourth on masks only where cameras have",
    )
    first_masks: Literal["flow", "none"] = Field(
        "flow", description="masks of the first of several rounds: from flow alone, or none, which saves their time"
    )
    intrinsics: IntrinsicsOption = Field(
        ESTIMATE,
        description="focal length: estimate it, or what is known: truth, exif, a focal length as in '1200 px' or "
        "'26 mm / 36 mm', [fx, fy, cx, cy], or a COLMAP cameras.txt",
    )
    holdout_every: int = Field(8, ge=2, description="one frame in this many is held out from training")
    holdout_first: int = Field(4, ge=0, description="0-based index of the first held-out frame")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to train and render")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of everything random")
    simulate: SimulateOptions = SimulateOptions()
    video: VideoOptions = VideoOptions()
    inspect: InspectOptions = InspectOptions()
    flow: FlowOptions = FlowOptions()
    lens: LensOptions = LensOptions()
    motion: MotionOptions = MotionOptions()
    segment: SegmentOptions = SegmentOptions()
    ba: BAOptions = BAOptions()
    scene: SceneOptions = SceneOptions()
    control: ControlOptions = ControlOptions()
    gaussians: GaussiansOptions = GaussiansOptions()
    render: RenderOptions = RenderOptions()
    export: ExportOptions = ExportOptions()
    evaluate: EvaluateOptions = EvaluateOptions()
    colmap: ColmapOptions = ColmapOptions()
    report: ReportOptions = ReportOptions()
    sweep: SweepOptions = SweepOptions()
    scaling: ScalingOptions = ScalingOptions()

    @field_validator("shots", mode="before")
    @classmethod
    def _read_shots(cls, value: Any) -> Any:
        return read_option(value)

    @field_validator("scenes", "sequences")
    @classmethod
    def _not_none_at_all(cls, names: str | list[str]) -> str | list[str]:
        """Refuse an empty list: there would be nothing to run."""
        if not names:
            raise ValueError("'all' or at least one name")
        return names


LENS = "lens.distortion"
SHARED_KEYS = ("intrinsics", "holdout_every", "holdout_first", "device", "seed")
"""Top-level keys that sections inherit."""


def load(raw: Mapping[str, Any], mine: Mapping[str, Any] | None = None) -> Config:
    """Check a parsed config.yaml (merged with its overrides) and apply its preset, and what given poses make needless.

    Args:
        mine: values from the user's own files and flags. They win over the preset, as does every value that differs
            from the default.

    Raises:
        OptionError: one line for the first wrong value.
    """
    config = validate(Config, raw)
    _refuse_idle(config)
    if LENS in idle_effects(config):
        raw = override(raw, {LENS: "no"})
    values, defaults = config.model_dump(by_alias=True), Config().model_dump(by_alias=True)
    needless = (FIXED_POSES if config.segment.estimates else FIXED_ALL) if config.ba.poses_fixed else {}
    open_values = {
        name: value
        for name, value in (PRESETS[config.preset] | needless).items()
        if value_of(mine or {}, name) is None and value_of(values, name) == value_of(defaults, name)
    }
    return validate(Config, override(raw, open_values))


def idle_effects(config: Config) -> dict[str, str]:
    """The effects of the camera, by dotted name, that what is given leaves no room for, and why.

    Cameras, masks and depth that the user hands in are of the frames as they are; given intrinsics are one focal length
    for all frames; poses that are held fixed are those of all rows.
    """
    adjustment = section(config, "ba")
    assert isinstance(adjustment, BAOptions), "the section of ba"
    taken = (adjustment.intrinsics, adjustment.poses_from, adjustment.depth_from)
    found = {}
    if config.segment.given or config.segment.evidence or any(value not in (ESTIMATE, TRUTH) for value in taken):
        found[LENS] = "intrinsics, poses, depth, or masks to use or go by are given: they do not fit undistorted frames"
    if adjustment.intrinsics != ESTIMATE or adjustment.poses_fixed:
        found["ba.zoom"] = "intrinsics or fixed poses are given: their focal lengths are not estimated"
    if adjustment.poses_fixed:
        found["ba.rolling_shutter"] = "fixed poses are given: they are not estimated, nor is a readout"
    return found


def _refuse_idle(config: Config) -> None:
    """Refuse an effect that is asked for where there is no room for it: it would be ignored."""
    for option, reason in idle_effects(config).items():
        name, key = option.split(".")
        if getattr(getattr(config, name), key) == "yes":
            advice = f"leave out what is given, or `{name}: {{{key}: yes}}`"
            raise OptionError([name, key], f"no or auto where {reason}", "'yes'", advice)


def section(config: Config, name: str) -> Options:
    """The options of one stage: its section, with the shared top-level keys that the section does not set."""
    options: Options = getattr(config, name)
    inherited = {key: getattr(config, key) for key in SHARED_KEYS if key in type(options).model_fields}
    chosen = inherited | {key: getattr(options, key) for key in options.model_fields_set}
    return type(options)(**(options.model_dump() | chosen))


def keys_of(config: Config, option: str) -> list[str]:
    """The keys that lead to the value of a stage's option: those of its dotted name, or the top-level key's alone."""
    name, _, key = option.partition(".")
    inherited = key in SHARED_KEYS and key not in getattr(config, name).model_fields_set
    return [key] if inherited else [name, key]


def flags(config: Config, name: str) -> str:
    """The command-line flags of one stage."""
    return to_flags(section(config, name))
