"""Pictures of clips of a thousand frames: what moves is shown, lines stay lines."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.gaussians import figure
from stages.report import figures
from stages.shared import charts
from stages.shared.drawing import fullest
from stages.shared.tables import write_rows


def test_the_frames_shown_of_a_long_clip_are_those_with_most_in_them() -> None:
    shares = np.zeros(1000)
    shares[[40, 300, 301, 990]] = 0.1, 0.2, 0.3, 0.1
    assert fullest(shares, 4).tolist() == [40, 301, 500, 990]
    assert fullest(shares[:50], 4).tolist() == [0, 16, 33, 49]


@pytest.mark.parametrize(("count", "run"), [(200, 1), (1000, 8)])
def test_a_chart_of_many_frames_shows_means_of_runs(
    count: int, run: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(charts, "draw_lines", lambda series, *_, **__: drawn.update(series) or b"")
    about = {"kind": "masks", "method": "prior", "split": None, "metric": "iou"}
    rows = [about | {"frame": n, "value": float(n % 2)} for n in range(1, count + 1)]
    write_rows(tmp_path / "eval/frames.parquet", rows, ("frame", *about, "value"), {})
    (shown,) = figures._frame_chart(tmp_path, "masks", "iou", "Overlap", "IoU")
    frames, values = map(np.array, drawn["prior"])
    assert len(frames) == len(values) <= count // run + 1
    assert np.all(np.diff(frames) >= min(run, run / 2 + 0.5))
    assert (f"(mean of {run} frames)" in shown.title) == (run > 1)
    assert "0.5 on average" in shown.alt
    if run > 1:
        assert np.allclose(values[1:-1], 0.5)


def test_a_training_of_fewer_steps_than_frames_has_a_curve() -> None:
    steps = list(range(1, 41))
    history = SimpleNamespace(step=steps, psnr=[20 + step / 10 for step in steps], n_gaussians=[1000] * 40)
    trainer: Any = SimpleNamespace(history=history, targets=range(100))
    picture = figure._curve(trainer).astype(int)
    blue = np.abs(picture - (0x1F, 0x5F, 0xA8)).max(axis=-1) < 12
    assert np.ptp(np.nonzero(blue)[1]) > 0.5 * figure.WIDTH_PX
