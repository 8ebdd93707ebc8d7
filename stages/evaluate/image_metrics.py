"""PSNR and SSIM under one named convention, whole and per region."""

import cv2
import numpy as np

from stages.shared.psnr import psnr_db

WINDOW_PX, SIGMA_PX = 11, 1.5
K1, K2 = 0.01, 0.03
PROTOCOL = (
    "8-bit RGB in 0..1; PSNR per frame over all pixels and channels of the region, at most 58.9 dB "
    "(the rounding to 8 bits), then the mean over frames; "
    "SSIM (Wang et al. 2004) with an 11-pixel Gaussian window of sigma 1.5 per channel, K1 0.01, K2 0.03, "
    "population covariance, mean over channels and over the pixels whose window lies inside the image"
)


def psnr(image: np.ndarray, truth: np.ndarray, region: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of images [H, W, 3] in 0..1, at most that of `stages.shared.psnr`.

    Args:
        region: [H, W] bool, the pixels that count (at least one); all if None.
    """
    squared = (np.asarray(image, float) - np.asarray(truth, float)) ** 2
    return psnr_db(float(np.mean(squared if region is None else squared[region])))


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Structural similarity [H-10, W-10] of images [H, W, 3] in 0..1, mean over channels, where the window fits."""
    x, y = np.asarray(image, float), np.asarray(truth, float)
    mu_x, mu_y = _blur(x), _blur(y)
    var_x, var_y = _blur(x * x) - mu_x**2, _blur(y * y) - mu_y**2
    covariance = _blur(x * y) - mu_x * mu_y
    c1, c2 = K1**2, K2**2
    luminance = (2 * mu_x * mu_y + c1) / (mu_x**2 + mu_y**2 + c1)
    return np.asarray((luminance * (2 * covariance + c2) / (var_x + var_y + c2)).mean(axis=-1))


def inside(region: np.ndarray) -> np.ndarray:
    """A region [H, W] cut to the pixels of `ssim_map`."""
    margin = WINDOW_PX // 2
    return region[margin:-margin, margin:-margin]


def _blur(image: np.ndarray) -> np.ndarray:
    blurred = cv2.GaussianBlur(image, (WINDOW_PX, WINDOW_PX), SIGMA_PX)
    return np.asarray(inside(blurred))
