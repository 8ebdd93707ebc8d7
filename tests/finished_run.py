"""A small finished run with known errors: a textured wall with a moving square, filmed by a moving camera."""

from pathlib import Path

import cv2
import numpy as np

from stages.evaluate import __main__ as evaluate_stage
from stages.evaluate.options import EvaluateOptions
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared import lie, sintel
from stages.shared.artifacts import write_dense, write_json, write_model, write_table
from stages.shared.cameras import centred_intrinsics, make_cameras, pixel_grid, project, unproject, write_cameras
from stages.shared.images import write_image

T, W, H, WALL_Z, STRIDE = 8, 96, 64, 4.0, 4
K = centred_intrinsics(90.0, W, H)
STEPS = np.linspace(0, 1, T)
CENTRES = np.stack([STEPS, 0.2 * np.sin(3 * STEPS), 0.3 * STEPS**2], axis=1)
TURNS = lie.exp_so3(np.outer(STEPS, [0.02, -0.05, 0.03]))
CAM_FROM_WORLD = lie.inverse(lie.from_parts(TURNS, CENTRES))
SHIFT = 0.08  # the square moves this far to the right per frame, scene units
DECIDED = {
    "camera": "moving",
    "focal": {"decision": "estimated", "relative_sigma": 0.012, "reason": "", "focal_px": 90.0},
    "zoom": {"decision": "constant", "reason": "it saves 0.1 %", "gain": 0.001, "gain_sigma": 0.002},
    "rolling_shutter": {"decision": "rolling", "reason": "it saves 30 %"}
    | {"gain": 0.3, "gain_sigma": 0.02, "threshold": 0.04, "readout": 0.7, "readout_sigma": 0.05},
    "statistics": {"offset": 5, "flow_px": 2.5, "rotation_px": 3.5, "sampson_px": 0.1, "planar": False},
    "residual_px": 0.25,
    "static_share": 0.75,
    "covariance_std_factor": 20.0,
    "options": {"intrinsics": "estimate", "poses_from": "estimate", "depth_from": "estimate"},
}
"""What the adjustment writes beside its poses."""
TABLES = ("poses", "images", "masks", "checks", "time", "trajectory", "frames")
_RNG = np.random.default_rng(7)
TEXTURE = cv2.resize(_RNG.integers(0, 255, (60, 80, 3), dtype=np.uint8), (800, 600), interpolation=cv2.INTER_CUBIC)


def wall(k: int) -> tuple[np.ndarray, np.ndarray]:
    """World points [H, W, 3] seen in frame k, and their z-depth [H, W]."""
    uv = pixel_grid(H, W)
    rays = unproject(uv, np.ones((H, W)), CAM_FROM_WORLD[k], K) - CENTRES[k]
    depth = (WALL_Z - CENTRES[k, 2]) / rays[..., 2]
    return CENTRES[k] + rays * depth[..., None], depth


def moving(points: np.ndarray, k: int) -> np.ndarray:
    """Which wall points [H, W, 3] the square covers in frame k."""
    return (np.abs(points[..., 0] - 0.3 - SHIFT * k) < 0.35) & (np.abs(points[..., 1]) < 0.35)


def movers(points: np.ndarray, k: int) -> np.ndarray:
    """Those, and as many on their left, where a thing rests that moves in other frames."""
    return moving(points, k) | moving(points + np.array([0.7, 0, 0]), k)


def flow(k: int, j: int) -> np.ndarray:
    """Exact flow [H, W, 2] in pixels from frame k to frame j."""
    points, _ = wall(k)
    points = points + moving(points, k)[..., None] * [SHIFT * (j - k), 0, 0]
    return project(points, CAM_FROM_WORLD[j], K)[0] - pixel_grid(H, W)


def picture(k: int) -> np.ndarray:
    """Frame k [H, W, 3] uint8: a texture on the wall, an orange square that moves."""
    points, _ = wall(k)
    lookup = ((points[..., :2] + [4.0, 3.0]) * 100).astype(np.float32)
    image = cv2.remap(TEXTURE, lookup[..., 0], lookup[..., 1], cv2.INTER_LINEAR)
    image[moving(points, k)] = (230, 120, 30)
    return image


def write_dataset(root: Path, name: str = "wall", truth: bool = True) -> Path:
    """The sequence in MPI-Sintel layout, with all truth or none; returns the folder of frames."""
    for k in range(T):
        stem = f"frame_{k + 1:04d}"
        write_image(root / f"training/final/{name}/{stem}.png", picture(k))
        if not truth:
            continue
        points, depth = wall(k)
        write_image(root / f"training/motion_mask/{name}/{stem}.png", moving(points, k))
        write_image(root / f"training/mover_mask/{name}/{stem}.png", movers(points, k))
        if k % 4 == 0:
            write_image(root / f"training/clean_right/{name}/{stem}.png", picture(k))
        if k < T - 1:
            (root / f"training/flow/{name}").mkdir(parents=True, exist_ok=True)
            sintel.write_flo(root / f"training/flow/{name}/{stem}.flo", flow(k, k + 1))
        for kind in ("depth", "camdata_left"):
            (root / f"training/{kind}/{name}").mkdir(parents=True, exist_ok=True)
        sintel.write_dpt(root / f"training/depth/{name}/{stem}.dpt", depth)
        sintel.write_cam(root / f"training/camdata_left/{name}/{stem}.cam", K, CAM_FROM_WORLD[k, :3])
    return root / "training" / "final" / name


def write_results(folder: Path) -> None:
    """What every stage before the evaluation writes: the truth at half size, in the frame of the first camera."""
    numbers = np.arange(1, T + 1)
    masks = np.stack([moving(wall(k)[0], k) for k in range(T)])
    estimated = CAM_FROM_WORLD @ lie.inverse(CAM_FROM_WORLD[0])
    estimated[:, :3, 3] *= 0.5
    _write_flow(folder / "flow/pairs.arrow")
    for part in ("round1/", ""):
        prior = np.roll(masks, 2, axis=2).astype(np.float16)
        columns = {"frame": numbers, "probability": prior, "weight": np.ones_like(prior)}
        write_dense(folder / part / "motion/prior.arrow", columns)
        for number, mask in zip(numbers, masks, strict=True):
            write_image(folder / part / f"masks/frame_{number:04d}.png", mask)
        write_json(folder / part / "masks/masks.json", {"options": {"source": "refined"}})
        about = {**DECIDED, "flags": ["an early warning"] if part else ["a warning", "one more"]}
        write_cameras(folder / part / "ba/poses.parquet", make_cameras(estimated, K, numbers), about)
    _write_depth(folder / "ba/depth.arrow", masks)
    _write_convergence(folder)
    _write_models(folder)
    for k in range(T):
        split = "test" if k == 4 else "train"
        write_image(folder / f"renders/{split}/frame_{k + 1:04d}.png", cv2.GaussianBlur(picture(k), (0, 0), 0.6))
    write_image(folder / "renders/right/frame_0001.png", picture(0))
    write_image(folder / "figures/flow.png", picture(0))
    decision = {"needed": True, "evidence": {"share": 0.1}, "why": "a square moves", "source": "evidence"}
    decision |= {"statistic": 2.5, "interval": [2.0, 3.0], "threshold": 0.15, "unit": "px", "seconds": 0.5}
    write_json(folder / "scene.json", {"dynamic": decision, "exposure": decision | {"needed": False}})
    _write_baseline(folder / "colmap/poses.parquet", estimated)
    cost = {
        "code": "abc",
        "threads": 2,
        "wall_s": 2.0,
        "cpu_s": 3.0,
        "peak_mb": 100.0,
        "gpu_peak_mb": None,
        "output_mb": 1.0,
    }
    for path in stats_files(folder):
        write_json(path, {"stage": path.stem, "options": {"seed": 0}, **cost})


def _write_flow(path: Path) -> None:
    """Exact flow between neighbours, both ways."""
    pairs = [(i, j) for i in range(T) for j in (i - 1, i + 1) if 0 <= j < T]
    flows = np.stack([flow(i, j) for i, j in pairs])
    source, target = np.array(pairs).T
    columns = {"source": source, "target": target, "flow": flows.astype(np.float16)}
    columns["confidence"] = np.ones(flows.shape[:3], np.float16)
    write_dense(path, columns, {"width": W, "height": H, "scale": 1.0, "source": "dis"})


def _write_depth(path: Path, masks: np.ndarray) -> None:
    """True depth at half size on every fourth pixel."""
    uv = pixel_grid(H // STRIDE, W // STRIDE).astype(int) * STRIDE + STRIDE // 2
    depth = np.stack([wall(k)[1] for k in range(T)])[:, uv[..., 1], uv[..., 0]] * 0.5
    filled = masks[:, uv[..., 1], uv[..., 0]].astype(np.uint8)
    columns = {"frame": np.arange(1, T + 1), "inverse_depth": (1 / depth).astype(np.float32), "filled": filled}
    columns["variance"] = np.ones_like(columns["inverse_depth"])
    write_dense(path, columns, {"stride_px": STRIDE})


def _write_convergence(folder: Path) -> None:
    steps = np.arange(5)
    phases = {"phase": ["start", "start", *["refinement"] * 3], "sigma_px": [1.0, 1.0, 1.0, 0.5, 0.5]}
    write_table(folder / "ba/convergence.parquet", {"iteration": steps, "cost": 10.0 / (1 + steps), **phases})
    write_table(folder / "gaussians/convergence.parquet", {"step": steps, "loss": 1.0 / (1 + steps)})


def _write_models(folder: Path) -> None:
    """100 control points in 5 knots that carry 50 of 1000 Gaussians."""
    fit = {"status": "fitted", "median_px": 0.2, "p90_px": 0.7, "control_points": 100, "tracks": 300, "attempts": 1}
    table = {"table": np.zeros((5, 100, 7), np.float32)}
    write_model(folder / "control/deformation.safetensors", table, fit)
    tensors = {"means": np.zeros((1000, 3), np.float32), "deformation.table": table["table"]}
    counts = {"n_static": 950, "n_dynamic": 50}
    write_model(folder / "gaussians/model.safetensors", tensors, counts)
    small = {name: values.astype(np.float16) for name, values in tensors.items()}
    quality = {"training_psnr_db": 30.0, "psnr_loss_db": 0.02}
    write_model(folder / "gaussians/model_half.safetensors", small, counts | quality)


def stats_files(folder: Path) -> list[Path]:
    """The time files that the evaluation reads."""
    once = [
        folder / f"stats/{name}.json" for name in ("inspect", "flow", "lens", "scene", "control", "gaussians", "render")
    ]
    once.append(folder / "stats/colmap.json")
    return once + [
        folder / part / f"stats/{name}.json" for part in ("round1", "") for name in ("motion", "segment", "ba")
    ]


def finish(root: Path, name: str = "wall", truth: bool = True) -> Path:
    """Dataset, results of all stages and their evaluation; returns the result folder."""
    frames = write_dataset(root, name, truth)
    folder = root / "results" / name
    inspect_stage.main(frames, folder / "sequence.json", folder / "figures" / "inspect.png", PartOptions())
    write_results(folder)
    score(folder)
    return folder


def score(folder: Path) -> None:
    """The evaluation of the results in a folder."""
    parts = [folder / "round1", folder]
    evaluate_stage.main(
        sequence=folder / "sequence.json",
        flow=folder / "flow/pairs.arrow",
        priors=[part / "motion/prior.arrow" for part in parts],
        masks=[part / "masks" for part in parts],
        poses=[part / "ba/poses.parquet" for part in parts],
        depth=folder / "ba/depth.arrow",
        colmap=[folder / "colmap/poses.parquet"],
        deformation=folder / "control/deformation.safetensors",
        model=folder / "gaussians/model.safetensors",
        half=folder / "gaussians/model_half.safetensors",
        renders=folder / "renders",
        stage_stats=stats_files(folder),
        **{f"{kind}_table": folder / f"eval/{kind}.parquet" for kind in TABLES},
        figure=folder / "figures/trajectory.png",
        options=EvaluateOptions(),
    )


def _write_baseline(path: Path, cam_from_world: np.ndarray) -> None:
    """A baseline that lost half of the frames, and one that failed."""
    quats, rows = lie.quat_from_matrix(cam_from_world[:, :3, :3]), range(4)
    columns = {"method": ["COLMAP global"] * 4, "frame": [k + 1 for k in rows]}
    columns |= {name: [quats[k, i] for k in rows] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {name: [cam_from_world[k, i, 3] for k in rows] for i, name in enumerate(("tx", "ty", "tz"))}
    columns |= {name: [value] * 4 for name, value in (("fx", 99.0), ("fy", 99.0), ("cx", K[0, 2]), ("cy", K[1, 2]))}
    about = {"protocol": "as is", "total": T, "wall_s": 1.5, "cpu_s": 1.5, "threads": 1, "taken": None}
    partial = {"method": "COLMAP global", "registered": 4, "failure": None}
    failed = {"method": "COLMAP incremental", "registered": 0, "failure": "reconstruct: no model"}
    write_table(path, columns, {"variants": [partial | about, failed | about]})
