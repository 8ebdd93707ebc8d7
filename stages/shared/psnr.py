"""Peak signal-to-noise ratio from a mean squared error, finite also for equal images."""

import math

ROUNDING_MSE = 1 / 12 / 255**2
"""Mean squared error of rounding an image to 8 bits, a lower limit of the error that 8-bit frames can show. Without a
limit the infinite PSNR of equal images (a copied blank clip) would make every mean over frames infinite."""


def psnr_db(mse: float) -> float:
    """PSNR in dB for the mean squared error of images in 0..1; at most 58.9 dB, the value for `ROUNDING_MSE`."""
    return -10 * math.log10(max(mse, ROUNDING_MSE))
