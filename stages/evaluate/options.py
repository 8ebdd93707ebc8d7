"""Options of the evaluation."""

from pathlib import Path

from pydantic import Field, field_validator

from stages.shared.split import SplitOptions


class EvaluateOptions(SplitOptions):
    """Scores of poses, images and masks."""

    lpips_weights: Path | None = Field(
        None,
        description="file with the state dict of lpips.LPIPS(net='alex'), as torch saves it; without it LPIPS is n/a",
    )

    @field_validator("lpips_weights")
    @classmethod
    def _is_a_file(cls, value: Path | None) -> Path | None:
        if value is not None and not value.is_file():
            raise ValueError("an existing file")
        return value
