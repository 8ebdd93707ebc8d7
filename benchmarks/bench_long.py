"""Seconds, resident memory and disk of every stage on the first 50, 200 and 1,000 frames of one clip.

Run as `make bench-long`, or on any scene of the library, scene file, folder of frames or video:

    python -m benchmarks.bench_long --scene long_take --frames 50 100 200 --folder bench_long
    python -m benchmarks.bench_long --scene clip.mp4 --frames 100 300 900 --config preset=fast
    python -m benchmarks.bench_long --scene long_walk --frames 300 --width 1920 --height 1080 --folder bench_wide

Further words go to Snakemake. A scene that is wider than 512 px is drawn as wide as that, and its frames are enlarged.
The clip is not played back and forth: its camera must go on, or frames that see a place again would make it easier than
it is. Each number of frames is a setting of `inspect: max_frames` as in `snakemake scaling`, in one folder. A stage
that has been measured under the same options and code is not run again, so a run that was stopped goes on; `--frames`
with a further number adds that alone. Where the whole clip is among them, the growth part of the report in that folder
shows the same runs. One number of frames runs after the other, smallest first, and COLMAP is cut off after a second.

Wall seconds need an otherwise idle machine; the goal for the time is tested on CPU seconds. The goal for the memory is
tested on what a stage holds and cannot give back (`benchmarks/resident.py`).
"""

import argparse
import contextlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.bench_memory import DRAWN_PX, MIB, REPO, draw_frames, enlarge, snakemake
from benchmarks.resident import watched
from stages.comparisons import growth, scaling, tradeoff_charts
from stages.configuration import config as configuration
from stages.configuration import datasets
from stages.report.provenance import about_run
from stages.shared.artifacts import read_json
from stages.shared.chain import STAGES
from stages.shared.errors import InputError
from stages.shared.tables import Column, Row, Table

ORDER = (*STAGES[:-1], "viewer", STAGES[-1])
GOAL_MB, GOAL_EXPONENT = 6000.0, 1.1
WIDTH_PX, HEIGHT_PX = 512, 218
SAMPLES = "resident.json"
UNMEASURED: dict[str, Any] = {
    "pixels": {"flow.max_side_px": []},
    "gaussians": {"gaussians.stride_px": []},
    "control points": {"control.control_points": []},
}
"""The other axes of the scaling, switched off."""
WARM_UP = {
    "inspect": {"max_frames": 5},
    "control": {"steps": 5},
    "gaussians": {"steps": 5},
    "colmap": {"time_limit_s": 1},
}
"""Options of a run that compiles the kernels; the smallest number of frames would pay for them otherwise."""
MEASURES = {
    "cpu_s": ("CPU, s", 1),
    "wall_s": ("wall, s", 1),
    "resident_mb": ("resident, MB", 0),
    "peak_mb": ("with mapped files, MB", 0),
    "output_mb": ("written, MB", 1),
    "meanwhile_mb": ("held meanwhile, MB", 1),
}
SAMPLED = ("resident_mb", "meanwhile_mb")
PANELS = {"cpu_s": "CPU seconds", "resident_mb": "resident memory (MB)", "output_mb": "written (MB)"}
ALL = "all"
ABOUT = f"""\
Numbers in a cell are those at the numbers of frames in the heading. Seconds and megabytes written are summed over the
rounds, memory is the highest of any round. Resident: anonymous and shared pages, sampled four times a second, which
is what a stage needs; with mapped files: the peak of the process (`ru_maxrss`) with pages of memory-mapped files,
which the kernel takes back when memory is short. Written: the files that a stage leaves, also if they are removed
later. Held meanwhile: blocks, checkpoints and unfinished outputs, which a stage removes or renames, and files without
a name (training: the depth of movers), sampled alike. Exponents: of a power of the number of frames beside a fixed
part, with the range that fits within 5 %, as in the growth part of the report. The row `all` holds sums of seconds
and megabytes written, and the highest of the others. Goals: at most {GOAL_MB:.0f} MB resident, and an exponent of CPU
seconds of at most {GOAL_EXPONENT}. MB are 1e6 bytes."""


def clip_options(scene: str, folder: Path, width: int, height: int, count: int) -> dict[str, Any]:
    """The options that choose the clip: a scene of the library or of a file at this size, or a path as it is.

    Args:
        count: of the frames that are enlarged, where the scene is wider than DRAWN_PX.
    """
    library = {file.stem: file for file in datasets.SCENES.rglob("*.yaml")}
    file = library.get(scene, Path(scene))
    if file.suffix not in (".yaml", ".yml"):
        if not file.exists():
            raise InputError(scene, "a scene of the library, a scene file, frames or a video", "neither", "name one")
        return {"dataset": str(file.resolve())} | ({"video": {"max_frames": "all"}} if file.is_file() else {})
    if width > DRAWN_PX:
        return {"dataset": str(enlarged(file, folder, width, height, count))}
    drawn = yaml.safe_load(file.read_text()) | {"width": width, "height": height}
    copy = folder / f"{file.stem}.yaml"
    if not copy.is_file() or yaml.safe_load(copy.read_text()) != drawn:  # rewritten, it would be drawn again
        copy.write_text(yaml.safe_dump(drawn))
    return {"dataset": "simulated", "scenes": [str(copy)]}


def enlarged(scene: Path, folder: Path, width: int, height: int, count: int) -> Path:
    """A folder of the first frames of a scene, drawn DRAWN_PX wide and enlarged; kept where it has enough."""
    clip = folder / f"{scene.stem}_{width}x{height}"
    if len(list(clip.glob("*.png"))) < count:
        clip.mkdir(exist_ok=True)
        drawn = draw_frames(folder, yaml.safe_load(scene.read_text()), width, height)[:count]
        enlarge(drawn, width, height)
        for path in drawn:
            path.rename(clip / path.name)
    return clip


def find_clip(folder: Path, options: Mapping[str, Any]) -> tuple[Path, int]:
    """The folder of the clip's results, and its number of frames.

    Raises:
        InputError: for a dataset of several sequences.
    """
    shipped = yaml.safe_load((REPO / "config.yaml").read_text())
    config = configuration.load(shipped | options, options)
    with contextlib.chdir(folder):
        shots = datasets.video_shots(config)
        clips = datasets.find_sequences(config, datasets.frame_folders(config, shots), shots, headers=False)
        found, _ = datasets.divided(config, clips, shots)
    if len(found) != 1:
        raise InputError(config.dataset, "one sequence", ", ".join(found), "name one clip without cuts")
    ((name, sequence),) = found.items()
    return folder / "results" / datasets.dataset_name(config) / name, len(sequence.frames)


def setting_of(count: int, length: int) -> str:
    """The folder of the results on `count` frames, within that of the sequence; the whole clip is as configured."""
    return "" if count == length else f"settings/inspect.max_frames={count}/"


def scaling_options(sizes: Sequence[int], length: int) -> dict[str, Any]:
    """The growth over these numbers of frames; the whole clip is the configured run, which an axis holds besides."""
    shorter = [n for n in sizes if n < length]
    return {"scaling": {"axes": UNMEASURED | {"frames": {"inspect.max_frames": shorter}}}}


def run(folder: Path, home: Path, options: Mapping[str, Any], settings: Sequence[str], words: Sequence[str]) -> None:
    """Compile the kernels, then run all stages under each setting in turn; SAMPLES keeps what was sampled."""
    (folder / "warm").mkdir(exist_ok=True)
    snakemake(folder / "warm", WARM_UP, "--cores", "all")
    within = home.relative_to(folder)
    targets = [[f"{within}/{setting}stats/{last}.json" for last in ("viewer", "evaluate")] for setting in settings]
    for asked in [*targets, *([["scaling"]] if "" in settings[1:] else [])]:
        with watched(folder, folder / SAMPLES):
            snakemake(folder, options, "--cores", "all", *asked, *words)


def measured(folder: Path, home: Path, settings: Sequence[str]) -> list[Row]:
    """A row per stage and number of frames, from the time files: as of the scaling, and what was sampled."""
    peaks = read_json(folder / SAMPLES)
    rows = []
    for setting in settings:
        found = sorted((home / setting).glob("stats/*.json")) + sorted((home / setting).glob("round*/stats/*.json"))
        stats = {stage: [file for file in found if file.stem == stage] for stage in ORDER}
        listed = {stage: [str(file.relative_to(home)) for file in files] for stage, files in stats.items() if files}
        frames = {"sequence": setting, "axis": "frames", "size": f"{setting}sequence.json", "stats": listed}
        for row in scaling.run_rows(home, frames):
            samples = [peaks.get(str(file.relative_to(folder)), {}) for file in stats[row["stage"]]]
            highest = {key: max((sample[key] for sample in samples if sample), default=None) for key in SAMPLED}
            rows.append(row | {"peak_mb": row["peak_mb"] * MIB} | highest)
    return rows


def with_all(rows: Sequence[Row]) -> list[Row]:
    """The rows, and one over all stages per number of frames: sums of what adds up, the highest of the rest."""
    totals = []
    for n in dict.fromkeys(row["n"] for row in rows):
        of_size = [row for row in rows if row["n"] == n]
        total: Row = {"axis": "frames", "n": n, "stage": ALL}
        for measure in MEASURES:
            values = [row[measure] for row in of_size if row[measure] is not None]
            total[measure] = max(values, default=None) if measure in (*SAMPLED, "peak_mb") else sum(values)
        totals.append(total)
    return [*rows, *totals]


def table_of(rows: Sequence[Row]) -> Table:
    """A row per stage, all numbers of frames in a cell, with exponents and whether the goals are met."""
    series = {measure: growth.series_of(rows, "frames", measure) for measure in MEASURES}
    counts = next(iter(series["cpu_s"].values()))[0]
    sizes = " / ".join(f"{n:g}" for n in counts)
    shown = []
    for stage in series["cpu_s"]:
        line: Row = {"stage": stage}
        for measure, (_, digits) in MEASURES.items():
            known = dict(zip(*series[measure].get(stage, ((), ())), strict=True))
            line[measure] = " / ".join(f"{known[n]:.{digits}f}" if n in known else "-" for n in counts)
        fits = {measure: growth.fit_growth(*series[measure][stage]) for measure in ("cpu_s", "wall_s")}
        line |= {f"{measure}_growth": fit.words() if fit else "too few sizes" for measure, fit in fits.items()}
        shown.append(line | {"goals": verdict(series["resident_mb"].get(stage), fits["cpu_s"])})
    columns = [Column("stage", "stage"), *(Column(key, f"{label} at {sizes}") for key, (label, _) in MEASURES.items())]
    columns += [Column("cpu_s_growth", "exponent of CPU s"), Column("wall_s_growth", "of wall s")]
    return Table("long", "Every stage", "", (*columns, Column("goals", "goals")), shown)


def verdict(resident: tuple[np.ndarray, np.ndarray] | None, law: growth.Growth | None) -> str:
    """Whether the memory at every size and the growth of CPU seconds meet their goals, in words."""
    if resident is None:
        memory = "memory not sampled"
    else:
        memory = "memory met" if resident[1].max() <= GOAL_MB else "MEMORY MISSED"
    if law is None or law.words() == "not determined":
        return f"{memory}, time not determined"
    return f"{memory}, {'time met' if law.exponent <= GOAL_EXPONENT else 'TIME MISSED'}"


def page(rows: Sequence[Row], about: Mapping[str, str], clip: str, chart: str) -> str:
    """The page as Markdown: clip, machine, the chart with its numbers in words, and the table."""
    series = growth.series_of(rows, "frames", "cpu_s")
    ends = [f"{stage} {values[0]:.0f} to {values[-1]:.0f} CPU s" for stage, (_, values) in series.items()]
    alt = f"CPU seconds, resident memory and megabytes written of the stages over frames: {', '.join(ends)}"
    written = f"{clip}. {about['written']}, commit {about['commit']}, {about['machine']}."
    chunks = ["# Long video", "Written by `python -m benchmarks.bench_long`; not edited by hand.", written]
    return "\n\n".join([*chunks, *([f"![{alt}]({chart})"] if chart else []), ABOUT, table_of(rows).markdown()]) + "\n"


def main() -> None:
    """Run what has not been measured, print the page, and write it and its chart if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="long_take", help="scene of the library, scene file, frames or video")
    parser.add_argument("--frames", type=int, nargs="+", default=[50, 200, 1000])
    parser.add_argument("--width", type=int, default=WIDTH_PX, help="of a scene, pixels")
    parser.add_argument("--height", type=int, default=HEIGHT_PX, help="of a scene, pixels")
    parser.add_argument("--folder", type=Path, default=Path("bench_long"), help="where to work, and to go on")
    parser.add_argument("--page", type=Path, help="where to write the page, Markdown (default: nowhere)")
    parser.add_argument("--chart", type=Path, help="where to draw it, PNG (default: nowhere)")
    given, words = parser.parse_known_args()
    folder, sizes = given.folder.resolve(), sorted(set(given.frames))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        options = clip_options(given.scene, folder, given.width, given.height, sizes[-1])
        home, length = find_clip(folder, options)
        if sizes[-1] > length:
            raise InputError("--frames", f"at most the {length} of {given.scene}", str(sizes[-1]), "cut it shorter")
    except InputError as error:
        sys.exit(str(error))
    options |= {"colmap": {"time_limit_s": 1}} | scaling_options(sizes, length)
    settings = [setting_of(count, length) for count in sizes]
    run(folder, home, options, settings, words)
    rows = with_all(measured(folder, home, settings))
    asked = " ".join(["`make bench-long`" if given.page else "`bench_long`", *words])
    clip = f"{asked}: the first {', '.join(map(str, sizes))} of {length} frames of {Path(given.scene).name}"
    chart = given.chart.name if given.chart else ""
    text = page(rows, about_run(), clip, chart)
    print(text)
    if given.page:
        given.page.write_text(text)
    if given.chart:
        panels = {label: growth.series_of(rows, "frames", measure) for measure, label in PANELS.items()}
        given.chart.write_bytes(tradeoff_charts.draw_growths(panels, "frames", {PANELS["resident_mb"]: GOAL_MB}))


if __name__ == "__main__":
    main()
