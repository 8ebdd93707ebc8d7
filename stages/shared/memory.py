"""Memory that a job asks for: a constant, plus bytes for each pixel that its stage holds at the same time.

The coefficients are fitted to the peaks (`peak_mb`) in the time files of 35 library scenes (14 to 200 frames of
512 x 218 px, preset fast), of a real clip (24 frames of 854 x 480 px, and the same enlarged to 1920 x 1080) and, for
`flow` and `motion`, of 30 to 300 frames of 1920 x 1080 px. Those of `evaluate` and `colmap` are fitted to small frames
alone. The constants of `motion` and `gaussians` include the compilation of their kernels. `simulate` and `report` read
no sequence and have a constant alone.
"""

from dataclasses import dataclass

MARGIN = 1.15
"""Factor on the fitted memory: peaks vary with the content of the frames, mostly by up to a tenth."""
RETRY = 1.5
"""Factor on the memory from one attempt of a job to the next."""


@dataclass(frozen=True)
class Held:
    """Numbers of pixels that a job may hold.

    Attributes:
        edges: in the flow of all edges: number of edges x size of the flow grid.
        frames: in all frames at full size.
        frame: in one frame at full size.
    """

    edges: int = 0
    frames: int = 0
    frame: int = 0


@dataclass(frozen=True)
class Need:
    """Memory of a stage: constant megabytes, and bytes per pixel of each kind in `Held`."""

    base_mb: float
    per_edges: float = 0
    per_frames: float = 0
    per_frame: float = 0


NEEDS = {
    "simulate": Need(520),
    "inspect": Need(120, per_frame=17),
    "flow": Need(150, per_edges=18.5),
    "motion": Need(325, per_edges=27.6),
    "segment": Need(125, per_edges=7.8),
    "ba": Need(350, per_edges=9.7),
    "scene": Need(215, per_edges=19.2),
    "control": Need(600, per_edges=6.5),
    "gaussians": Need(670, per_frames=60),
    "render": Need(560, per_frame=65),
    "colmap": Need(260, per_frames=10, per_frame=250),
    "evaluate": Need(225, per_edges=8.4, per_frames=15),
    "report": Need(1300),
}


def megabytes(stage: str, held: Held, attempt: int = 1) -> int:
    """The megabytes (1e6 bytes) that a job of a stage asks for at its first, second, ... attempt."""
    need = NEEDS[stage]
    pixels = need.per_edges * held.edges + need.per_frames * held.frames + need.per_frame * held.frame
    return round(MARGIN * (need.base_mb + pixels / 1e6) * RETRY ** (attempt - 1))
