"""Options of Gaussian training."""

from typing import Literal, Self

from pydantic import Field

from stages.shared.options import MAX_SEED
from stages.shared.split import SplitOptions

SHORT_CLIP = 40
"""Training frames up to which a clip is trained in `steps` steps; a longer one takes more in proportion, so that each
of its frames is seen as often."""


class GaussiansOptions(SplitOptions):
    """Two-stage training of the 4D Gaussian scene (stage 2)."""

    steps: int = Field(
        1000,
        ge=0,
        le=100_000,
        description="optimisation steps, one training frame each, of up to 40 training frames; more frames take more"
        " steps in proportion; 0: the result of stage 1",
    )
    stride_px: int = Field(
        2, ge=1, le=16, description="one initial Gaussian per this many pixels, each way; of movers one px finer"
    )
    movers_every: int = Field(
        3,
        ge=0,
        le=1000,
        description="dynamic Gaussians start from one training frame in this many, and each is seen around the time of"
        " its own; 0: one canonical cloud for all time, as the paper",
    )
    max_gaussians: int = Field(
        80_000, ge=1, description="largest number of Gaussians, initially and after densification"
    )
    densify: bool = Field(True, description="split Gaussians where the image gradient is high, prune transparent ones")
    neighbours: int = Field(4, ge=1, le=16, description="control points that move one Gaussian")
    colour_table: bool = Field(True, description="let control points change their colour over time, as shading does")
    refine_poses: bool = Field(False, description="optimise small corrections of the estimated poses with the scene")
    detach: bool = Field(
        False,
        description="keep the motion of stage 1 as it is, as the paper reads literally: no photometric gradient to the"
        " control points' motion and radii, and no ARAP",
    )
    learning_rate: float = Field(1.0, gt=0, le=10, description="factor on all learning rates")
    ssim_weight: float = Field(0.2, ge=0, le=1, description="share of D-SSIM in the photometric loss; the rest is L1")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of the order of frames")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to train")

    def of_length(self, frames: int) -> Self:
        """The options with the steps of a clip of so many training frames."""
        return self.model_copy(update={"steps": max(self.steps, -(-self.steps * frames // SHORT_CLIP))})
