"""Parameters of the effects of the final pass. An effect that a scene does not list is not run and changes no pixel."""

from typing import Any

from pydantic import Field, field_validator

from stages.shared.options import Options
from stages.simulate.shape_models import Colour


class MotionBlur(Options):
    """Average over the time during which the shutter is open, centred on the frame."""

    shutter: float = Field(gt=0, le=1, description="open time in frames; 0.5 is a film camera's 180 degrees")
    samples: int = Field(8, ge=2, le=64, description="number of times that are averaged")


class RollingShutter(Options):
    """Rows are exposed one after the other, the middle one at the time of the frame.

    The ground truth and the clean pass are those of that time in all rows: what a global shutter sees.
    """

    readout: float = Field(
        ge=-1, le=1, description="time from the first row to the last, in frames; negative: the last row comes first"
    )


class Defocus(Options):
    """Thin-lens blur by depth."""

    focus: float = Field(gt=0, description="sharp depth, metres")
    aperture_px: float = Field(gt=0, le=20, description="blur radius at infinity, pixels")


class Fog(Options):
    """Homogeneous fog: radiance tends to `colour` as exp(-density * distance)."""

    density: float = Field(gt=0, le=10, description="extinction, 1 / metre")
    colour: Colour = Field(description="linear RGB")


class Specular(Options):
    """Blinn-Phong highlights of the sun on glossy textures."""

    exponent: float = Field(gt=0, le=1000, description="larger is sharper")
    strength: float = Field(gt=0, le=10, description="peak radiance on a surface of gloss 1, in units of the sun")


class Shadows(Options):
    """Cast shadows of the sun."""

    darkness: float = Field(gt=0, le=1, description="share of the sun's light that is lost in shadow")


class Exposure(Options):
    """Exposure and white balance that change over the clip as smooth random curves."""

    stops: float = Field(ge=0, le=4, description="largest change of exposure, factors of two")
    white_balance: float = Field(ge=0, le=0.5, description="largest opposite change of the red and blue gains")


class Noise(Options):
    """Sensor noise: shot noise of `photons` at white, and read noise."""

    photons: float = Field(gt=1, le=1e7, description="photo-electrons at display white")
    read: float = Field(ge=0, le=0.5, description="standard deviation of the read noise, of display white")


class Flicker(Options):
    """Bands of brightness that move through the frame, as with a rolling shutter under lamps on alternating current."""

    amplitude: float = Field(gt=0, le=0.9, description="relative change of brightness")
    rows: float = Field(gt=0, le=1e4, description="height of one band cycle, pixels")
    hz: float = Field(ge=0, le=1000, description="cycles per second at one row")


class Vignette(Options):
    """Darkening towards the corners."""

    strength: float = Field(gt=0, le=1, description="share of the light that is lost in the corners")


class Effects(Options):
    """The effects of the final pass, each with its parameters or absent."""

    shadows: Shadows | None = None
    specular: Specular | None = None
    fog: Fog | None = None
    motion_blur: MotionBlur | None = None
    rolling_shutter: RollingShutter | None = None
    defocus: Defocus | None = None
    vignette: Vignette | None = None
    flicker: Flicker | None = None
    exposure: Exposure | None = None
    noise: Noise | None = None

    @field_validator("*", mode="before")
    @classmethod
    def _has_parameters(cls, value: Any) -> Any:
        """Treat a listed effect without parameters as one with missing parameters, which is an error, not as absent."""
        return {} if value is None else value

    @property
    def listed(self) -> list[str]:
        """Names of the effects that the scene lists."""
        return [name for name in type(self).model_fields if getattr(self, name) is not None]
