"""Small tables of a sweep and of a scaling with known numbers."""

from pathlib import Path
from typing import Any

from stages.shared.tables import write_rows

METRICS = (
    *("rpe_rot_deg", "focal_error_percent", "iou", "boundary_f", "psnr_static_db", "psnr_dynamic_db", "ssim"),
    *("ate", "rpe_trans", "path", "registered", "total", "threads"),
    *("cpu_s", "differing_cpu_s", "poses_cpu_s", "peak_mb", "model_mb"),
    *("step_ms", "equal_psnr_db", "equal_s", "configured_equal_s"),
)


def cost_row(setting: str, ate: float | None, seconds: float, psnr: float = 20.0, **changes: Any) -> dict[str, Any]:
    """A row of the sweep's table."""
    row: dict[str, Any] = {
        "sequence": "wall",
        "group": "presets",
        "setting": setting,
        "knob": None,
        "value": None,
        "is_default": False,
        "overrides": "{}",
        "effects": "",
    }
    row |= dict.fromkeys(METRICS, 1.0) | {"ate_percent": ate, "psnr_db": psnr, "status": "ok"}
    row |= {"note": "", "taken": "true masks" if "truth" in str(changes) else None}
    return row | {"poses_wall_s": seconds / 2, "wall_s": seconds} | changes


def cost_rows() -> list[dict[str, Any]]:
    """Presets, one knob and true masks on one sequence."""
    knob: dict[str, Any] = {"group": "knobs", "knob": "ba.stride_px"}
    return [
        cost_row("fast", 2.0, 30, 19.0),
        cost_row("balanced", 1.0, 60, 21.0, is_default=True),
        cost_row("accurate", 0.5, 180, 22.0),
        *(cost_row(f"ba.stride_px={v}", a, s, **knob, value=v) for v, a, s in (("4", 0.7, 90), ("16", 1.5, 50))),
        cost_row("ba.stride_px=8", 1.0, 60, 21.0, **knob, value="8", is_default=True),
        cost_row("true", 0.2, 10, group="masks", overrides='{"segment.source": "truth"}'),
    ]


def growth_rows() -> list[dict[str, Any]]:
    """Two stages over two axes, one of them with too few sizes for a fit."""
    return [
        {"axis": axis, "n": n, "stage": stage, "wall_s": n**power, "cpu_s": 2.0 * n**power, "peak_mb": 100.0}
        | {"output_mb": 6.0 * n}
        for axis, sizes in (("frames", (5, 10, 20)), ("pixels", (1e4, 2e4)))
        for n in sizes
        for stage, power in (("flow", 1.0), ("ba", 1.5))
    ]


def write(folder: Path, made: dict[str, Any]) -> tuple[Path, Path]:
    """Both tables as files that say how the runs beside them were made."""
    paths = folder / "sweep/costs.parquet", folder / "scaling/growth.parquet"
    for path, rows in zip(paths, (cost_rows(), growth_rows()), strict=True):
        write_rows(path, rows, list(rows[0]), {"made_under": made})
    return paths
