"""Files that the training of the small scene reads and writes."""

from pathlib import Path

import gaussian_scene as truth

from stages.deformation.point_files import save_deformation, save_points


def write_inputs(folder: Path) -> dict[str, Path]:
    """The inputs of the training of the small scene, by the names of its parameters."""
    truth.write_artifacts(folder)
    save_points(folder / "points.parquet", truth.true_motion(), {})
    said = {"canonical_frame": truth.T // 2 + 1, "arap_weight": 0.01, "region": "dynamic"}
    save_deformation(folder / "deformation.safetensors", truth.true_motion(), said)
    names = {"sequence": "sequence.json", "masks": "masks", "poses": "poses.parquet", "depth": "depth.arrow"}
    names |= {"scene": "scene.json", "points": "points.parquet", "deformation": "deformation.safetensors"}
    return {name: folder / file for name, file in names.items()}


def outputs(folder: Path) -> dict[str, Path]:
    """Where it writes, in a folder that need not exist."""
    names = {"ply": "gaussians.ply", "model": "model.safetensors", "half": "model_half.safetensors"}
    names |= {"convergence": "convergence.parquet", "figure": "figure.png"}
    return {name: folder / file for name, file in names.items()}
