"""The pace of the fly-through: as GIF in the report and as video in an export."""

SECONDS_PER_FRAME = 1 / 12
"""If frames have no time stamps."""
SLOWEST_S, FASTEST_S = 0.2, 0.04
"""Of a frame of the fly-through that lasts as long as the video."""


def seconds_per_frame(times_s: list[float] | None, count: int) -> float:
    """How long each of `count` frames of the fly-through is shown, by the time stamps [T] of the frames, if any."""
    if times_s is None:
        return SECONDS_PER_FRAME
    return min(max((times_s[-1] - times_s[0]) / (count - 1), FASTEST_S), SLOWEST_S)
