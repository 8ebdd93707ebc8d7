"""Figures of one sequence in the report, from its result folder, each with its content in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.evaluate.ground_truth import true_masks
from stages.evaluate.score_images import true_images
from stages.report import embedding
from stages.shared import charts, sequences, sintel
from stages.shared.artifacts import read_dense, read_table
from stages.shared.drawing import fullest, spread
from stages.shared.images import numbered_frames, read_rgb
from stages.shared.masks import read_instances, read_masks
from stages.shared.run_inputs import PRIOR_MASKS, mask_source
from stages.shared.tables import Row, read_rows

SHOWN_FRAMES = 4
CHART_POINTS = 125
"""From twice as many frames on a chart shows means of runs of them."""
STAGE_FIGURES = {
    "inspect": "Input frames, with true motion where it is known",
    "motion": "Motion prior: how likely each pixel moves in the world",
    "segment": "Mask refinement",
    "ba": "Bundle adjustment",
    "scene": "Evidence for the effects",
    "control": "Control points",
    "gaussians": "Gaussian training",
}


@dataclass(frozen=True)
class Figure:
    """A picture or chart.

    Attributes:
        source: data URI. alt: its content in words. wide: whether it takes the whole width of the page.
    """

    title: str
    source: str
    alt: str
    wide: bool = False


def _svg(title: str, content: bytes, alt: str) -> Figure:
    return Figure(title, embedding.data_uri(content, "image/svg+xml"), alt)


class MissingPart(Exception):
    """A part of the results is missing; the message names it: "masks", "rows in ba/convergence.parquet"."""


def _existing(folder: Path, name: str) -> Path:
    if not (folder / name).exists():
        raise MissingPart(name)
    return folder / name


def trajectory_figures(folder: Path) -> list[Figure]:
    """Camera paths, and the error of every camera where there is truth; raises MissingPart."""
    rows = read_rows(_existing(folder, "eval/trajectory.parquet"))
    paths = charts.paths_of(rows)
    listed = ", ".join(paths) or "no method"
    found = [
        _svg("Camera path from above", charts.draw_top(rows), f"Camera centres of {listed}, seen from above"),
        _svg("Camera path in 3D", charts.draw_space(rows), f"Camera centres of {listed} in three dimensions"),
    ]
    errors = _series([row for row in rows if row["error"] is not None and row["method"] in paths], "error")
    if errors:
        worst = {method: max(values[1]) for method, values in errors.items()}
        words = ", ".join(f"{method} at most {value:.3g}" for method, value in worst.items())
        chart = charts.draw_lines(errors, ("frame", "distance to truth (scene units)"), list(paths), zero=True)
        found.append(
            _svg("Error of every camera", chart, f"Distance to the true camera per frame: {words} scene units")
        )
    return found


def _series(rows: Sequence[Row], key: str) -> dict[str, tuple[list[float], list[float]]]:
    """Frame numbers and values by method."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        frames, values = found.setdefault(row["method"], ([], []))
        frames.append(row["frame"])
        values.append(row[key])
    return found


def mask_figures(folder: Path, sequence: sequences.Sequence) -> list[Figure]:
    """Masks over some frames beside the true ones, and their IoU by frame; raises MissingPart."""
    masks = read_masks(_existing(folder, "masks"), sequence)
    truth, _ = true_masks(sequence)
    shares = np.array([masks[number].mean() for number in sequence.numbers])
    chosen = fullest(shares, SHOWN_FRAMES)
    shown = [sequence.numbers[k] for k in chosen]
    instances = [read_instances(folder / "masks", sequence, k) for k in chosen]
    images = [read_rgb(sequence.frames[k]) for k in chosen]
    sheet = embedding.mask_sheet(images, instances, [truth.get(n) for n in shown])
    outline = "; blue outline: the true ones" if truth else ""
    meaning = f"tinted: called dynamic, a colour for each instance{outline}"
    title = f"Masks of frames {', '.join(map(str, shown))} ({meaning})"
    share = 100 * shares.mean()
    figures = [
        Figure(title, embedding.webp(sheet), f"Frames with dynamic masks covering {share:.1f} % on average", True)
    ]
    return figures + _frame_chart(folder, "masks", "iou", "Mask overlap per frame", "IoU")


def _frame_chart(folder: Path, kind: str, metric: str, title: str, label: str) -> list[Figure]:
    rows = read_rows(_existing(folder, "eval/frames.parquet"))
    chosen = [row for row in rows if row["kind"] == kind and row["metric"] == metric]
    for row in chosen:
        row["method"] = row["method"] if row["split"] is None else f"{row['method']}, {row['split']}"
    series = _series(chosen, "value")
    if not series:
        return []
    words = ", ".join(f"{name} {np.mean(values[1]):.3g} on average" for name, values in series.items())
    run = max(1, max(len(values[1]) for values in series.values()) // CHART_POINTS)
    shown = {name: _means_of_runs(values, run) for name, values in series.items()}
    chart = charts.draw_lines(shown, ("frame", label), list(series), zero=metric == "iou")
    return [_svg(f"{title} (mean of {run} frames)" if run > 1 else title, chart, f"{label} per frame: {words}")]


def _means_of_runs(line: tuple[list[float], list[float]], run: int) -> tuple[list[float], list[float]]:
    """Frames and values as means over frames first..first + run - 1: a line through more points is a band of colour."""
    frames, values = np.array(line[0], float), np.array(line[1], float)
    numbered = np.unique(frames // run, return_inverse=True)[1]
    count = np.bincount(numbered)
    return tuple((np.bincount(numbered, x) / count).tolist() for x in (frames, values))


def flow_figures(folder: Path) -> list[Figure]:
    """Flow and its confidence; raises MissingPart."""
    image = read_rgb(_existing(folder, "figures/flow.png"))
    title = "Frames, optical flow (hue: direction, saturation: length), its confidence (yellow: sure)"
    return [Figure(title, embedding.webp(image), f"Picture of the flow stage. {title}", True)]


def depth_figures(folder: Path, sequence: sequences.Sequence) -> list[Figure]:
    """Inverse depth of some frames, beside the true one where there is one; raises MissingPart."""
    depth = read_dense(_existing(folder, "ba/depth.arrow"))
    shown = spread(len(sequence.numbers), 3)
    has_truth = sequence.has_truth("depth")
    files = [sequence.truth["depth"][sequence.numbers[k]] if has_truth else None for k in shown]
    truths = [sintel.read_dpt(file) if file else None for file in files]
    sheet = embedding.depth_sheet(depth["inverse_depth"][shown], truths)
    beside = " (ours, then the truth)" if has_truth else ""
    numbers = ", ".join(str(sequence.numbers[k]) for k in shown)
    title = f"Inverse depth of frames {numbers}{beside}, near is yellow"
    return [Figure(title, embedding.webp(sheet), f"Inverse depth maps of frames {numbers}{beside}", True)]


def render_figures(folder: Path, sequence: sequences.Sequence) -> list[Figure]:
    """Renders beside the true frames, the fly-through, and the PSNR by frame; raises MissingPart."""
    found = []
    for split, words in {"test": "held-out", "right": "right-eye"}.items():
        renders = numbered_frames(folder / "renders" / split)
        truth = true_images(sequence, split)
        numbers = [n for n in renders if n in truth]
        shown = [numbers[k] for k in spread(len(numbers), 2)] if numbers else []
        if shown:
            pairs = [(read_rgb(truth[n]), read_rgb(renders[n])) for n in shown]
            title = f"{words.capitalize()} frames {', '.join(map(str, shown))}: truth, render, difference x4"
            alt = f"True {words} frames, our renders and their difference"
            found.append(Figure(title, embedding.webp(embedding.comparison_sheet(pairs)), alt, True))
    if not found:
        raise MissingPart("renders/test")
    if (folder / "figures" / "render.gif").exists():
        fly = embedding.animation(folder / "figures" / "render.gif")
        found.append(Figure("Fly-through at moving time", fly, "Animation of the reconstructed scene from new views"))
    return found + _frame_chart(folder, "images", "psnr_db", "Image quality per frame", "PSNR (dB)")


def _rows_of(folder: Path, name: str) -> dict[str, np.ndarray]:
    """The columns of a table that has rows. It has none after 0 training steps or with true poses (no adjustment).

    Raises:
        MissingPart: if the table is missing or empty.
    """
    table = read_table(_existing(folder, name))
    if not len(next(iter(table.values()))):
        raise MissingPart(f"rows in {name}")
    return table


def adjustment_figures(folder: Path) -> list[Figure]:
    """Cost of the bundle adjustment by iteration; raises MissingPart."""
    steps = _rows_of(folder, "ba/convergence.parquet")
    cost = steps["cost"]
    runs = list(zip(steps["phase"].tolist(), steps["sigma_px"].tolist(), strict=True))
    title = "Bundle adjustment (orange: final refinement; grey: starts that compete)"
    alt = f"Robust cost over {len(cost)} iterations in {len(set(runs))} runs, at the end {cost[-1]:.4g}"
    return [_svg(title, charts.draw_runs(cost.tolist(), runs, "robust cost"), alt)]


def training_figures(folder: Path) -> list[Figure]:
    """Loss of the training of the Gaussians by step; raises MissingPart."""
    training = _rows_of(folder, "gaussians/convergence.parquet")
    window = max(1, len(training["loss"]) // 20)
    loss = np.convolve(training["loss"], np.full(window, 1 / window), "valid")
    line = {"ours": (training["step"][window - 1 :].tolist(), loss.tolist())}
    chart = charts.draw_lines(line, ("training step", "loss"), ["ours"], log=True)
    alt = f"Training loss, mean of {window} steps, from {loss[0]:.3g} to {loss[-1]:.3g}"
    return [_svg(f"Gaussian training (mean of {window} steps)", chart, alt)]


def stage_figures(folder: Path) -> list[Figure]:
    """The pictures that the stages drew of their own work; those that are not there are left out."""
    found = []
    for name, title in STAGE_FIGURES.items():
        path = folder / "figures" / f"{name}.png"
        if path.exists() and not (name == "motion" and _left_out_motion(folder)):
            picture = embedding.webp(read_rgb(path), embedding.STAGE_WIDTH_PX, embedding.STAGE_MAX_BYTES)
            found.append(Figure(title, picture, f"Picture of the {name} stage: {title}", True))
    return found


def _left_out_motion(folder: Path) -> bool:
    """Whether the masks are not made from a motion prior, so that its picture is that of an earlier run."""
    return (folder / "masks/masks.json").exists() and mask_source(folder / "masks") not in PRIOR_MASKS
