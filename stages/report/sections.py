"""The section of one sequence in the report: figures with alternative text, warnings, and missing parts."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from stages.evaluate import pose_diagnostics
from stages.report.figures import (
    Figure,
    MissingPart,
    adjustment_figures,
    depth_figures,
    flow_figures,
    mask_figures,
    render_figures,
    stage_figures,
    training_figures,
    trajectory_figures,
)
from stages.shared import sequences
from stages.shared.artifacts import read_json, read_metadata
from stages.shared.tables import Table


@dataclass
class Section:
    """One sequence in the report."""

    name: str
    about: str
    figures: list[Figure] = field(default_factory=list)
    stage_figures: list[Figure] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    more: list[Table] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def build_section(folder: Path) -> Section:
    """The section of a sequence, from the files in its result folder; absent parts are listed as missing."""
    content = read_json(folder / "sequence.json")
    undistorted = folder / "lens/sequence.json"
    sequence = sequences.read_sequence(undistorted if undistorted.exists() else folder / "sequence.json")
    truth = ", ".join(sorted(sequence.truth)) or "none"
    about = f"{len(sequence.frames)} frames, {sequence.width} x {sequence.height} px; truth to score against: {truth}"
    section = Section(sequence.name, about, missing=list(content.get("missing_truth", [])))
    section.warnings = [*sequence.warnings, *_warnings(folder)]
    parts: dict[str, Callable[[], list[Figure]]] = {
        "trajectories": partial(trajectory_figures, folder),
        "masks": partial(mask_figures, folder, sequence),
        "flow": partial(flow_figures, folder),
        "depth": partial(depth_figures, folder, sequence),
        "renders": partial(render_figures, folder, sequence),
        "adjustment": partial(adjustment_figures, folder),
        "training": partial(training_figures, folder),
    }
    for name, draw in parts.items():
        try:
            section.figures += draw()
        except MissingPart as missing:
            section.missing.append(f"{name}: no {missing}")
    section.figures.sort(key=lambda figure: figure.wide)  # charts side by side, then the pictures
    section.stage_figures = stage_figures(folder)
    return section


def _warnings(folder: Path) -> list[str]:
    model, warned = folder / "gaussians" / "model.safetensors", pose_diagnostics.warnings_of(folder)
    found = [f"Warnings of the bundle adjustment. {warned}"] if warned else []
    if model.exists() and read_metadata(model).get("status") == "poses failed":
        found.append("Gaussians: the poses failed: a static scene was trained before a camera at rest")
    return found
