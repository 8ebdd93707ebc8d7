"""One row per scene with all scores of a run, failed scenes included."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from stages.evaluate import costs, image_baselines, ratios
from stages.evaluate.score_images import REGIONS
from stages.evaluate.score_masks import PRIOR
from stages.shared.artifacts import read_json
from stages.shared.chain import STAGES
from stages.shared.digest import code_digest
from stages.shared.run_inputs import ESTIMATED_MASKS
from stages.shared.tables import Row, decimal, read_rows

OWN = "own"
"""The split of a scene whose file names none."""
MOVING_PERCENT = 0.01
"""If less than this percentage of the pixels truly moves, a scene has no mask scores."""


def score_rows(results: Path, scenes: Path | None = None, manifests: Path | None = None) -> list[Row]:
    """A row per sequence of a dataset's results, and per scene file without results, sorted by name.

    Args:
        results: results/<dataset>.
        scenes: folder of the scene files of the run.
        manifests: folder of the simulator's manifests, <sequence>.json.
    """
    names = {path.parent.name for path in results.glob("*/sequence.json")}
    promised = {path.stem: path for path in scenes.glob("*.yaml")} if scenes else {}
    return [
        {"sequence": name, "split": _split(name, promised, manifests)} | score_row(results / name)
        for name in sorted(names | set(promised))
    ]


def _split(name: str, promised: Mapping[str, Path], manifests: Path | None) -> str:
    """The split of a scene: from its manifest, otherwise from its file."""
    manifest = manifests / f"{name}.json" if manifests else None
    if manifest and manifest.exists():
        return str(read_json(manifest).get("split", OWN))
    return str(yaml.safe_load(promised[name].read_text()).get("split", OWN)) if name in promised else OWN


def score_row(folder: Path) -> Row:
    """Scores of a run on one sequence; for an unfinished run, `missing` is the first stage without results."""
    stages = [stage for stage in STAGES if stage != "motion" or _estimates_masks(folder / "stats/segment.json")]
    missing = next((stage for stage in stages if not (folder / f"stats/{stage}.json").exists()), None)
    if missing:
        return {"status": "failed", "missing": missing}
    tables = {kind: read_rows(folder / f"eval/{kind}.parquet") for kind in ("poses", "images", "masks", "time")}
    times = [row for row in tables["time"] if costs.is_ours(row)]
    row: Row = {"frames": len(read_json(folder / "sequence.json")["numbers"])}
    row |= _camera_scores(tables["poses"]) | _mask_scores(tables["masks"]) | _image_scores(tables["images"])
    row |= {key: sum(line[key] for line in times) for key in ("wall_s", "cpu_s")}
    old = [stage for stage in stages if not is_current(folder / f"stats/{stage}.json")]
    return row | {"threads": max(line["threads"] for line in times), "old": ", ".join(old) or None}


def _estimates_masks(stats: Path) -> bool:
    """Whether masks come from the motion prior; without it, motion does not run."""
    source = read_json(stats)["options"].get("source", "refined") if stats.exists() else "refined"
    return source in ESTIMATED_MASKS[:2]


def is_current(stats: Path) -> bool:
    """Whether a stage ran with the code of this checkout."""
    content = read_json(stats)
    return bool(content["code"] == code_digest(f"stages.{content['stage']}"))


def _camera_scores(poses: Sequence[Row]) -> Row:
    ours = next(row for row in poses if row["method"] == "ours")
    rivals = ratios.plain_rivals(poses, ours["sequence"])
    rival = ratios.best_rival(rivals)
    names = ("status", "ate_percent", "focal_error_percent", "taken", "camera", "warnings")
    found = {name: ours[name] for name in names}
    rotation = {"rotation_deg": ours["rpe_rot_deg"] if ours["ate_percent"] is None else None}
    return {
        **found,
        **rotation,
        "failure": ours["note"] if ours["status"] == "failed" else None,
        "flags": in_short(ours["flags"]),
        "error": error_in_words(ours),
        "poses_s": ours["wall_s"],
        "poses_cpu_s": ours["cpu_s"],
        "colmap": rival["method"] if rival else None,
        "colmap_percent": rival["ate_percent"] if rival else None,
        "colmap_error": error_in_words(rival) if rival else _incomplete(rivals),
        "colmap_cpu_s": rival["cpu_s"] if rival else None,
        "colmap_threads": max((row["threads"] for row in rivals), default=None),
    }


def error_in_words(row: Mapping[str, Any]) -> str | None:
    """The error in a row of the pose table, with its unit: ATE, or the rotation error if no ATE is defined."""
    if row["status"] == "failed":
        return "failed"
    if row["ate_percent"] is not None:
        partial = f" ({row['registered']} of {row['total']} frames)" if row["status"] == "partial" else ""
        return f"{decimal(row['ate_percent'], 3)} %{partial}"
    return None if row["rpe_rot_deg"] is None else f"{decimal(row['rpe_rot_deg'], 3)} deg"


def _incomplete(rivals: Sequence[Row]) -> str | None:
    """The outcome of COLMAP's variants, "partial" or "failed", if none is scored."""
    statuses = {row["status"] for row in rivals}
    return next((word for word in ("partial", "failed") if word in statuses), None)


def in_short(flags: str | None) -> str | None:
    """The flags of a pose estimate, each shortened to the text before its colon."""
    parts = (part.partition(":")[0].strip() for part in (flags or "").split("; "))
    return "; ".join(dict.fromkeys(part for part in parts if part)) or None


def _mask_scores(masks: Sequence[Row]) -> Row:
    """Scores of the masks of the last round; if nothing moves, the share of masked pixels instead."""
    used = max((row for row in masks if row["method"] != PRIOR), key=lambda row: row["round"])
    still = used["true_percent"] is not None and used["true_percent"] < MOVING_PERCENT
    names = ("iou", "mover_iou", "precision", "recall")
    scores = {name: None if still else used.get(name) for name in names}  # tables of older code have fewer
    return scores | {"masks": used["method"], "masked_percent": used["dynamic_percent"] if still else None}


def _image_scores(images: Sequence[Row]) -> Row:
    """Held-out scores of our renders and of warped neighbours; ours minus theirs where both have the same frames."""
    scores: Row = {}
    found = {(row["method"], row["split"], row["region"]): row for row in images}
    for region in REGIONS:
        ours, warp = (found.get((method, "test", region), {}) for method in ("ours", image_baselines.WARP))
        scores |= {f"psnr_{region}": ours.get("psnr_db"), f"warp_{region}": warp.get("psnr_db")}
        scores |= {f"ssim_{region}": ours.get("ssim"), f"warp_ssim_{region}": warp.get("ssim")}
        both = bool(ours) and bool(warp) and ours["frames"] == warp["frames"]
        scores[f"gain_{region}"] = ours["psnr_db"] - warp["psnr_db"] if both else None
    right = found.get(("ours", "right", "whole"), {})
    return scores | {"right_db": right.get("psnr_db")}
