"""Peak signal-to-noise ratio from a mean squared error, finite for equal images too."""

import math

ROUNDING_MSE = 1 / 12 / 255**2
"""What rounding a frame to 8 bits costs on average. Frames cannot show a smaller error, and the infinite PSNR of equal
images (a blank clip, copied) would leave nothing of a mean over frames."""


def psnr_db(mse: float) -> float:
    """PSNR in dB of the mean squared error of images in 0..1, at most 58.9: that of `ROUNDING_MSE`."""
    return -10 * math.log10(max(mse, ROUNDING_MSE))
