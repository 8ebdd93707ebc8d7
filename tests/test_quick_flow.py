"""Flow for looks at reduced frames, of any size."""

import cv2
import numpy as np
import pytest

from stages.shared.quick_flow import quick_flow


@pytest.mark.parametrize("size", [(31, 100), (8, 128), (24, 300), (7, 9)])
@pytest.mark.parametrize("preset", [cv2.DISOPTICAL_FLOW_PRESET_FAST, cv2.DISOPTICAL_FLOW_PRESET_MEDIUM])
def test_small_frames_and_strips_have_flow(size: tuple[int, int], preset: int) -> None:
    """OpenCV itself crashes the process on some of them."""
    start = np.ones((*size, 2), np.float32)
    image = np.random.default_rng(0).integers(0, 255, size, np.uint8)
    for begun in (None, start):
        flow = quick_flow(image, image, preset, begun)
        assert flow.shape == (*size, 2)
        assert np.isfinite(flow).all()


def test_a_strip_that_moves_is_followed() -> None:
    noise = np.random.default_rng(1).normal(size=(24, 202)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    flow = quick_flow(texture[:, 2:], texture[:, :-2], cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    assert np.median(flow[..., 0]) == pytest.approx(2, abs=0.2)
    assert np.median(flow[..., 1]) == pytest.approx(0, abs=0.2)
