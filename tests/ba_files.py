"""Input files of the pose script for exact scenes, and where a run of it writes."""

from pathlib import Path

import numpy as np
from conftest import write_frames

from stages.shared.artifacts import write_dense, write_json
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json


def write_inputs(folder: Path, edges: tuple[np.ndarray, ...], dynamic: np.ndarray) -> dict[str, Path]:
    """Files for edges (source, target, flow, confidence) and masks [T, h, w] on the full frame."""
    T, h, w = dynamic.shape
    frames = write_frames(folder / "clip", count=T, size=(h, w))
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("clip", frames)))
    source, target, flow, confidence = edges
    columns = {"source": source, "target": target, "flow": flow.astype(np.float16)}
    columns["confidence"] = confidence.astype(np.float16)
    write_dense(folder / "pairs.arrow", columns, {"width": w, "height": h, "scale": 1.0})
    for k, mask in enumerate(dynamic, start=1):
        write_image(folder / "masks" / f"frame_{k:04d}.png", mask)
    return {"sequence": folder / "sequence.json", "flow": folder / "pairs.arrow", "masks": folder / "masks"}


def outputs(folder: Path) -> dict[str, Path]:
    """Where a run of the script writes."""
    names = {"poses": "poses.parquet", "trajectory": "trajectory.tum", "depth": "depth.arrow"}
    names |= {"convergence": "convergence.parquet", "figure": "ba.png"}
    return {key: folder / name for key, name in names.items()}
