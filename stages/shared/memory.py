"""Memory that a job asks for: a constant, plus bytes for each pixel that its stage holds at the same time.

Coefficients are fitted to the peaks (`peak_mb`) in the time files of 35 library scenes (14 to 200 frames of 512 x 218
px, preset fast), of a real clip (24 frames of 854 x 480 px, and the same enlarged to 1920 x 1080), and of clips of

    python -m benchmarks.bench_memory
    python -m benchmarks.bench_memory --frames 24 --width 1920 --height 1080 --until render --config rounds=1
    python -m benchmarks.bench_memory --frames 300 --width 1920 --height 1080 --until control --config rounds=1

Of the 300 frames, `inspect` to `lens` asked for 1.04 to 1.26 times what they used (`inspect` with its base of today:
1.28, by calculation). `scene`, `control`, `gaussians` and `evaluate`, which read frames and flow as they need them,
were measured on few frames since, `scene` also on the 300 (1.5 GB used, 1.2 times as much asked); how the others grow
follows from what they keep, by calculation: of `gaussians` 39 bytes per pixel of the training frames up to 2 GB
(`inputs.PICTURE_BYTES`, `optimise.TARGET_BYTES`), of `scene` 29 bytes per pixel of the flow grid (`HELD_BYTES`) and
the motion of 48 frames. `colmap` was measured on small frames alone. What `control` holds grows with what moves: 8 %
of the pixels were assumed. `export` was measured on 8 frames with all formats. The bases of `motion`, `ba` and
`gaussians` leave room for a process that compiles kernels, which takes up to 110 MB more.
Of flow a stage keeps columns of up to 32 MB (`rows.SHORT_BYTES`), measured on the demo since, `motion` and `ba` up to
256 MB (`rows.OFTEN_READ_BYTES`), flow and confidence each: they were measured with it on 24 frames of 512 x 218 px, and
on 200 of 320 x 136, whose confidence alone is kept. The number of edges is the largest possible: where a clip has few
far ones, its flow may be kept though none is asked for (54 to 74 frames of 512 x 218 px, about 100 MB).
`simulate` and `report`, which read no sequence, have a constant.
`motion` was measured on 24 frames of 512 x 218 px and on 200 of 320 x 136 since it keeps the flow, and the surroundings
of long tracks in 50 frames; the surfaces of 44 frames that `hiding` keeps after that are less, by calculation.
`ba` was measured before that on 200 frames on grids of 320 x 136 px (502 MiB) and, its flow enlarged, 512 x 218 (624
MiB, 1570 edges), and on 40 of the former (335 MiB).
`lens` was measured on 28 frames of 384 x 216 px and 200 of 512 x 218 with a distortion, which takes more than none.
`flow`, `motion`, `segment` and the stages after the adjustment, but `export`, were measured on the 1,000 frames of
long_walk too, of 512 x 218 px with flow of 320 x 136.
`flow` was measured on 12, 50 and 300 frames of 512 x 218 px, and on those of long_walk with its loops.
`segment` was measured on 24 frames of 512 x 218 px and on those of long_walk since it compares pictures, which takes
240, 280 and 400 MB more than the flow alone on 100, 400 and 1,000 frames of the latter. Before that it was measured on
12, 50 and 300 frames of 512 x 218 px, which were not measured again. One byte per pixel of the flow grid, what the
pictures show of it, was added by calculation. It keeps the links of a clip of one window since, with which 40 frames of
512 x 218 px take as much as without.
Since colours decide on borders it holds some frames at full size: `segment.boundaries` alone takes 75 MB more for
frames of 512 x 218 px and 256 MB more for 1920 x 1080.
Since a network decides near borders, 6 bytes per pixel of the flow grid were added by calculation; of 26 frames of
512 x 218 px, with a grid as large, it does not change the peak (462 and 470 MB without).
`scene` was measured on 14, 40 and 200 frames of 512 x 218 px since it looks for moving shadows, before that on 300 and
on those of long_walk; it keeps more of 200 frames than the bytes above, for which 45 per pixel are asked.
`video` was measured on 20 and 90 frames of 1920 x 1080, whose peaks are alike, and on 40 of 3840 x 2160, on 4 threads;
its pixels are those of a frame not yet reduced.
"""

from dataclasses import dataclass

MARGIN = 1.15
"""Factor on the fitted memory: peaks vary with the content of the frames, mostly by up to a tenth."""
FLOW, KEPT_FLOW_MB = (4, 2), 256
"""Bytes per pixel of flow and of its confidence, and the size of either up to which it is kept."""
KEPT_AT_PEAK = 0.75
"""Share of what is kept of the flow by which the peak rises: it is filled while less is held beside it."""
WINDOW = 80
"""Frames whose flow `flow` and `segment` hold at a time, about: they work on a window of the clip."""
RETRY = 1.5
"""Factor on the memory from one attempt of a job to the next."""


@dataclass(frozen=True)
class Held:
    """Numbers of pixels that a job may hold.

    Attributes:
        edges: in the flow of all edges: number of edges x size of the flow grid.
        frames: in all frames at full size.
        frame: in one frame at full size.
        grid: in all frames on the flow grid.
        window: in the flow of the edges of at most WINDOW frames.
    """

    edges: int = 0
    frames: int = 0
    frame: int = 0
    grid: int = 0
    window: int = 0


@dataclass(frozen=True)
class Need:
    """Memory of a stage: constant megabytes, and bytes per pixel of each kind in `Held`.

    What is kept of all frames in order not to read it again has a limit of its own, in megabytes. Flow is kept as a
    whole, or not.
    """

    base_mb: float
    per_edges: float = 0
    per_frames: float = 0
    per_frame: float = 0
    per_grid: float = 0
    per_window: float = 0
    kept_frames: float = 0
    kept_grid: float = 0
    kept_mb: float = 0
    keeps_flow: bool = False


NEEDS = {
    "simulate": Need(520),
    "video": Need(170, per_frame=30),
    "inspect": Need(135, per_frame=17),
    "flow": Need(230, per_grid=3, per_window=7.5),
    "lens": Need(360, per_edges=0.4, per_frame=40, per_window=0.7),
    "motion": Need(420, per_grid=31, per_window=2, keeps_flow=True),
    "segment": Need(380, per_frame=100, per_grid=18, per_window=5),
    "ba": Need(400, per_edges=1.5, keeps_flow=True),
    "scene": Need(180, per_grid=4, kept_grid=45, kept_mb=1200),
    "control": Need(590, per_grid=8, kept_grid=8, kept_mb=300),
    "gaussians": Need(785, per_frames=0.6, per_frame=370, kept_frames=34, kept_mb=2000),
    "render": Need(555, per_frames=0.6, per_frame=90),
    "viewer": Need(580, per_frames=0.35, per_frame=20),
    "colmap": Need(260, per_frames=10, per_frame=250),
    "evaluate": Need(195, per_edges=1, per_frames=0.75, per_frame=150),
    "export": Need(555, per_frame=138),
    "report": Need(1300),
}


def megabytes(stage: str, held: Held, attempt: int = 1) -> int:
    """The megabytes (1e6 bytes) that a job of a stage asks for at its first, second, ... attempt."""
    need = NEEDS[stage]
    pixels = need.per_edges * held.edges + need.per_frames * held.frames + need.per_frame * held.frame
    pixels += need.per_grid * held.grid + need.per_window * held.window
    kept_mb = min((need.kept_frames * held.frames + need.kept_grid * held.grid) / 1e6, need.kept_mb)
    columns_mb = [of_pixel * held.edges / 1e6 for of_pixel in FLOW] if need.keeps_flow else []
    kept_mb += KEPT_AT_PEAK * sum(column_mb for column_mb in columns_mb if column_mb <= KEPT_FLOW_MB)
    return round(MARGIN * (need.base_mb + pixels / 1e6 + kept_mb) * RETRY ** (attempt - 1))
