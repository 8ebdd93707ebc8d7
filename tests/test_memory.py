"""The memory that jobs ask for, against peaks measured on scenes and clips, and the number of edges it rests on."""

import math

import numpy as np
import pytest

from stages.flow.edges import edge_list, long_edges, most_edges
from stages.shared.images import reduced_size
from stages.shared.memory import KEPT_FLOW_MB, WINDOW, Held, megabytes
from stages.shared.rows import OFTEN_READ_BYTES

OFFSETS = {512: ((1, 2, 3, 5), 2), 320: ((1, 2, 4), 1), 256: ((1, 2, 3), 0)}
"""Offsets and long edges of the measured runs, by the longer side of their flow."""
LONG_WALK = {"flow": 609, "motion": 1603, "segment": 1061 + 249, "scene": 1610, "control": 1047, "gaussians": 3004}
"""Of `segment` the second part is by calculation, see `stages.shared.memory`."""
LONG_WALK |= {"render": 673, "viewer": 647, "evaluate": 638}
MEASURED = [
    *[("flow", 50, (512, 218), 512, 676), ("flow", 12, (512, 218), 512, 327), ("flow", 12, (512, 218), 320, 217)],
    *[("flow", 300, (512, 218), 512, 1050), ("motion", 24, (512, 218), 512, 642)],
    *[("motion", 200, (512, 218), 320, 769), ("ba", 200, (512, 218), 320, 593), ("ba", 24, (512, 218), 512, 510)],
    *[("lens", 28, (384, 216), 320, 389), ("lens", 200, (512, 218), 320, 388)],
    ("segment", 24, (512, 218), 512, 502),
    *[("scene", 14, (512, 218), 320, 187), ("scene", 40, (512, 218), 320, 280)],
    *[("scene", 200, (512, 218), 320, 641), ("scene", 300, (1920, 1080), 512, 1402)],
    *[("control", 24, (512, 218), 320, 611), ("control", 50, (256, 108), 256, 639)],
    *[("gaussians", 24, (512, 218), 320, 894), ("gaussians", 24, (1920, 1080), 512, 3137)],
    *[("render", 24, (1920, 1080), 512, 652), ("render", 24, (1920, 1080), 512, 785)],
    *[("render", 30, (512, 218), 512, 527), ("evaluate", 14, (512, 218), 320, 196)],
    *[("viewer", 14, (512, 218), 512, 527), ("viewer", 24, (1920, 1080), 512, 576)],
    *[("export", 8, (1920, 1080), 512, 802), ("export", 8, (256, 112), 512, 546)],
    *[(stage, 1000, (512, 218), 320, mib) for stage, mib in LONG_WALK.items()],
    *[("colmap", 24, (854, 480), 512, 424), ("inspect", 300, (1920, 1080), 512, 144)],
    *[("video", 90, (1920, 1080), 512, 219), ("video", 40, (3840, 2160), 512, 395)],
]
"""Stage, frames, their size, longer side of the flow, and the peak of the job in MiB."""


@pytest.mark.parametrize(("stage", "T", "size", "side", "peak_mib"), MEASURED)
def test_jobs_ask_for_what_they_use(stage: str, T: int, size: tuple[int, int], side: int, peak_mib: int) -> None:
    grid = math.prod(reduced_size(*size, side))
    edges, window = (most_edges(n, *OFFSETS[side]) * grid for n in (T, min(T, WINDOW)))
    asked = megabytes(stage, Held(edges, T * math.prod(size), math.prod(size), T * grid, window))
    assert 1.0 <= asked / (peak_mib * 1.048576) <= 1.3


def test_flow_is_kept_up_to_the_size_that_memory_is_asked_for() -> None:
    assert 1e6 * KEPT_FLOW_MB == OFTEN_READ_BYTES


def test_every_attempt_asks_for_more() -> None:
    first, second, third = (megabytes("flow", Held(window=10**9), attempt) for attempt in (1, 2, 3))
    assert third > second > first
    assert second == pytest.approx(1.5 * first, rel=1e-3)


@pytest.mark.parametrize("T", [3, 9, 40])
@pytest.mark.parametrize(("offsets", "per_frame"), [((1, 2, 3, 5), 2), ((1, 4), 7), ((1, 12), 1), ((1,), 0)])
def test_a_still_picture_has_the_most_edges(T: int, offsets: tuple[int, ...], per_frame: int) -> None:
    short = edge_list(T, offsets)
    far = long_edges({edge: np.zeros((16, 16, 2), np.float32) for edge in short}, T, per_frame)
    assert most_edges(T, offsets, per_frame) == len(short) + len(far)
