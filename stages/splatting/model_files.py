"""The 4D model as arrays and metadata for a safetensors file, in full or in half precision."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.deformation.point_files import deformation_from_tensors, deformation_tensors
from stages.shared.artifacts import read_metadata, read_model
from stages.shared.errors import complete
from stages.splatting.atmosphere import Atmosphere
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.life_spans import rows_of
from stages.splatting.ply import write_ply
from stages.splatting.pose_table import PoseTable
from stages.splatting.shadows import ShadowTable
from stages.splatting.spz import write_spz

DEFORMATION, COLOURS, EXPOSURE, POSES, AIR = "deformation.", "colours.", "exposure.", "poses.", "atmosphere."
SHADOWS = "shadows."
"""Prefixes of the tensors of the motion, the colours over time, the gains, the pose corrections, the fog and the
shadows that move over what rests."""
LIFE_SPANS = ("births", "log_spans", "drifts")
"""Tensors of the life spans, which dynamic Gaussians alone have."""
HALVED = (
    "means",
    "log_scales",
    "quats",
    "logits",
    "sh",
    "log_spans",
    "drifts",
    DEFORMATION + "table",
    COLOURS + "table",
    SHADOWS + "table",
)
"""Tensors that `halved` stores as float16. Births keep their precision: in a clip of 2,000 frames they would be off by
a fifth of a life span."""
MEANS_REST, REST_STEPS = "means_rest", 254
"""Tensor of what float16 leaves of the means, int8 in this many parts of the distance between its numbers."""
FARTHEST = 65472.0
"""Largest float16 but one, which still has a finite distance to the next. Means farther out are held here."""


def scene_tensors(scene: GaussianScene) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and metadata that rendering needs; footprints, which only training needs, are left out.

    The tensors are those of `Cloud`, in its shapes, `background` [3], and those of motion, colours, gains, pose
    corrections, fog and shadows with their prefixes. Life spans and drifts [D, ...] are those of the dynamic Gaussians,
    and left out if there are none.
    """
    cloud = scene.cloud()
    tensors = {name: value.cpu().numpy() for name, value in vars(cloud).items() if name != "footprints"}
    tensors["dynamic"] = tensors["dynamic"].astype(np.uint8)
    for name in LIFE_SPANS:
        spans = tensors.pop(name)[scene.n_static :]
        tensors |= {name: spans} if scene.fading else {}
    tensors["background"] = scene.background.cpu().numpy()
    if scene.deformation is not None:
        tensors |= {DEFORMATION + name: value for name, value in deformation_tensors(scene.deformation).items()}
    for prefix, module in (
        (COLOURS, scene.colours),
        (EXPOSURE, scene.exposure),
        (POSES, scene.poses),
        (AIR, scene.atmosphere),
        (SHADOWS, scene.shadows),
    ):
        state = {} if module is None else module.state_dict()
        tensors |= {prefix + name: value.cpu().numpy() for name, value in state.items()}
    settings = {"near_plane": scene.near_plane, "neighbours": scene.neighbours, "sh_degree": scene.sh_degree}
    counts = {"n_static": scene.n_static, "n_dynamic": len(scene.anchors) - scene.n_static}
    return tensors, settings | counts


def halved(
    tensors: Mapping[str, np.ndarray], settings: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The same model with the tensors HALVED as float16.

    Means are divided by the median distance from the origin of those that are not at it (`unit` in the metadata), since
    float16 ends at 65504, and held within FARTHEST. Their relative error of up to 1/2048 would be a quarter of a pixel
    at the border of frames 512 px wide; with MEANS_REST it is about 1/250 of that. Quaternions may have any length and
    are scaled to a largest entry of 1.
    """
    distances = np.linalg.norm(tensors["means"], axis=-1)
    unit = float(np.median(distances[distances > 0])) if distances.any() else 1.0
    lengths = np.abs(tensors["quats"]).max(axis=-1, keepdims=True)
    scaled = {"quats": tensors["quats"] / lengths}
    scaled |= {name: tensors[name] / unit for name in ("means", "drifts") if name in tensors}
    scaled["means"] = scaled["means"].clip(-FARTHEST, FARTHEST)
    small = {name: (scaled.get(name, tensors[name])).astype(np.float16) for name in HALVED if name in tensors}
    parts = REST_STEPS * (scaled["means"] - small["means"]) / _spacing(small["means"])
    small[MEANS_REST] = np.rint(parts).clip(-127, 127).astype(np.int8)
    return {**tensors, **small}, {**settings, "unit": unit}


def _spacing(halves: np.ndarray) -> np.ndarray:
    """Distance from each float16 to the next larger one in magnitude, float32."""
    return np.spacing(np.abs(halves)).astype(np.float32)


def scene_from_tensors(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, Any]) -> GaussianScene:
    """Rebuild the scene, for rendering, from the result of `scene_tensors` or `halved`."""
    arrays = {name: value.astype(np.float32) if value.dtype == np.float16 else value for name, value in tensors.items()}
    if MEANS_REST in tensors:
        arrays["means"] += tensors[MEANS_REST] * (_spacing(tensors["means"]) / REST_STEPS)
    values = {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}
    cloud = Cloud(
        means=values["means"] * metadata.get("unit", 1.0),
        footprints=torch.ones(len(values["means"])),
        dynamic=values["dynamic"].bool(),
        **{name: values[name] for name in ("log_scales", "quats", "logits", "sh")},
    )
    if LIFE_SPANS[0] in values:
        cloud.births[cloud.dynamic], cloud.log_spans[cloud.dynamic] = values["births"], values["log_spans"]
        cloud.drifts[cloud.dynamic] = values["drifts"] * metadata.get("unit", 1.0)
    motion = {name.removeprefix(DEFORMATION): arrays[name] for name in arrays if name.startswith(DEFORMATION)}
    deformation = deformation_from_tensors(motion) if motion else None
    colours, exposure, poses = None, None, None
    if COLOURS + "knots" in values:
        colours = ColourTable(values[COLOURS + "knots"], values[COLOURS + "table"].shape[1])
        colours.load_state_dict({name: values[COLOURS + name] for name in ("knots", "table")})
    if EXPOSURE + "knots" in values:
        exposure = Exposure(values[EXPOSURE + "knots"], values[EXPOSURE + "log_gains"].shape[1])
        exposure.load_state_dict({name: values[EXPOSURE + name] for name in ("knots", "log_gains")})
    if POSES + "knots" in values:
        poses = PoseTable(values[POSES + "knots"], float(values[POSES + "length"]))
        poses.load_state_dict({name: values[POSES + name] for name in ("knots", "length", "twists")})
    air = (
        Atmosphere(float(values[AIR + "extinction"]), values[AIR + "airlight"]) if AIR + "airlight" in values else None
    )
    shadows = None
    if SHADOWS + "knots" in values:
        shadows = ShadowTable(*(values[SHADOWS + name] for name in ("knots", "points", "radii")))
        shadows.load_state_dict({name: values[SHADOWS + name] for name in ("knots", "points", "radii", "table")})
    settings = (metadata["near_plane"], metadata["neighbours"])
    return GaussianScene(cloud, deformation, values["background"], *settings, colours, exposure, poses, air, shadows)


def read_scene(path: Path) -> GaussianScene:
    """The scene of a model file in full or half precision, for rendering.

    Raises:
        InputError: if the file is not the model of a scene.
    """
    with complete(path, "a model of the Gaussians", "give gaussians/model.safetensors"):
        return scene_from_tensors(read_model(path), read_metadata(path))


@torch.no_grad()
def write_splats(path: Path, scene: GaussianScene, time: float) -> None:
    """Write the Gaussians that are there at `time` 0..1, as they are then, without gains and fog.

    The suffix says whether as .ply or .spz. Gaussians that are too transparent to be drawn at that time are left out.
    """
    opacities, rows = scene.opacities_at(time)
    means, quats, sh_dc = scene.at(time, rows=rows)
    values = scene.gaussians
    logits = values["logits"] if rows is None else opacities.logit(eps=1e-6)  # of an opacity of 1 it is infinite
    sh = torch.cat([sh_dc, rows_of(values["sh_rest"], rows)], dim=1)
    write = write_spz if path.suffix == ".spz" else write_ply
    write(path, *(x.cpu().numpy() for x in (means, quats, rows_of(values["log_scales"], rows), logits, sh)))
