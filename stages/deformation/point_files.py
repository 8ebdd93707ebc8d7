"""The files of the control points: `control/points.parquet` and `control/deformation.safetensors`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.deformation.motion_models import Deformation, MLPDeformation, TableDeformation
from stages.shared.artifacts import read_model, read_table, refuse_infinite, write_model, write_table


def deformation_tensors(deformation: Deformation) -> dict[str, np.ndarray]:
    """Every tensor of the model by name, enough to rebuild it; the names tell the kind."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in deformation.state_dict().items()}


def deformation_from_tensors(tensors: Mapping[str, np.ndarray]) -> Deformation:
    """Rebuild the model that `deformation_tensors` took apart."""
    state = {name: torch.from_numpy(np.array(values)) for name, values in tensors.items()}
    points, log_radii = state["points"], state["log_radii"]
    model: Deformation
    if "knots" in state:
        model = TableDeformation(points, log_radii, state["knots"])
    else:
        width, depth = len(state["hidden.0.weight"]), sum(name.endswith(".weight") for name in state) - 1
        model = MLPDeformation(points, log_radii, width, depth, *state["frequencies"].tolist())
    model.load_state_dict(state)
    return model


def save_points(path: Path, deformation: Deformation | None, metadata: Mapping[str, Any]) -> None:
    """Write `control/points.parquet`: x y z radius, in scene units of the canonical frame; no row without motion."""
    points = np.zeros((0, 3), np.float32) if deformation is None else deformation.points.cpu().numpy()
    radii = np.zeros(0, np.float32) if deformation is None else deformation.log_radii.detach().exp().cpu().numpy()
    columns = {name: points[:, axis] for axis, name in enumerate("xyz")} | {"radius": radii}
    write_table(path, columns, {"units": "scene units, canonical frame", **metadata})


def save_deformation(path: Path, deformation: Deformation | None, metadata: Mapping[str, Any]) -> None:
    """Write `control/deformation.safetensors`: the motion without the points; no tensor without motion."""
    tensors = {} if deformation is None else deformation_tensors(deformation)
    motion = {name: values for name, values in tensors.items() if name not in ("points", "log_radii")}
    write_model(path, motion, metadata)


def load_deformation(path: Path, points_path: Path) -> Deformation | None:
    """Read what `save_deformation` and `save_points` wrote; None for a scene without moving parts."""
    table = read_table(points_path)
    refuse_infinite(points_path, table)
    if len(table["x"]) == 0:
        return None
    points = np.stack([table[name] for name in "xyz"], axis=-1)
    return deformation_from_tensors(read_model(path) | {"points": points, "log_radii": np.log(table["radius"])})
