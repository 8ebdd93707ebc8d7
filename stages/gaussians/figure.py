"""Picture of the training for the report: frames, renders and their difference, and the PSNR over the steps."""

import numpy as np
import torch

from stages.gaussians.optimise import Trainer
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.drawing import contact_sheet, spread
from stages.shared.images import to_uint8
from stages.splatting.shutter import expose

WIDTH_PX = 1200
CURVE_POINTS = 4
"""Means that the curve consists of, at least, however many training frames there are."""
GAIN = 4
"""Factor on the differences shown."""


@torch.no_grad()
def training_figure(trainer: Trainer, seen: TrainingFrames) -> np.ndarray:
    """Frame, render and difference x GAIN of two training frames; below, the PSNR curve. [H, W, 3] uint8."""
    cells = []
    for f in spread(len(seen.images), 2):
        image = expose(trainer.scene, trainer.pictures[f], trainer.width, trainer.height)[0].cpu().numpy()
        difference = GAIN * np.abs(image - seen.images[f])
        cells += [to_uint8(seen.images[f]), to_uint8(image), to_uint8(difference)]
    sheet = contact_sheet(cells, columns=3, width_px=WIDTH_PX)
    return np.concatenate([sheet, _curve(trainer)]) if trainer.history.step else sheet


def _curve(trainer: Trainer) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure  # pyplot takes a quarter of a second more

    history = trainer.history
    # Mean over as many steps as there are training frames, or as leave a curve: PSNR differs between frames.
    round_of = min(len(trainer.targets), max(1, len(history.step) // CURVE_POINTS))
    psnr = np.convolve(history.psnr, np.full(round_of, 1 / round_of), mode="valid")
    dpi = 100
    drawing = Figure(figsize=(WIDTH_PX / dpi, 2.6), dpi=dpi, layout="constrained")
    canvas, left = FigureCanvasAgg(drawing), drawing.subplots()
    left.plot(history.step[-len(psnr) :], psnr, color="#1f5fa8")
    left.set(xlabel="step", ylabel="PSNR in a step, dB", xlim=(0, max(history.step)))
    left.grid(alpha=0.3)
    right = left.twinx()
    right.plot(history.step, np.array(history.n_gaussians) / 1000, color="#b0552b", linewidth=1)
    right.set_ylabel("Gaussians, thousands")
    right.set_ylim(bottom=0)
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(rgba[..., :3])
