"""From 30 frames to poses and masks: seconds of the presets against COLMAP's matching and incremental mapping.

Run as `python -m benchmarks.bench_poses`. The frames, 512 x 218 px, are those of a scene simulated beforehand. Our time
is that of `snakemake poses` from flow to bundle adjustment on all cores, including the start of every stage; the
seconds of the stages exclude Snakemake. COLMAP runs on one thread, as in the report, since with more threads its result
changes from run to run: compare CPU seconds.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from stages.evaluate import trajectory
from stages.evaluate.ground_truth import true_cameras
from stages.shared.artifacts import read_json, read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.sequences import read_sequence

SCENE, DATASET = "exposure_drift", "simulated"
GOALS_S = {"fast": 12.0, "balanced": 30.0}
REPOSITORY = Path(__file__).resolve().parents[1]


def run_snakemake(folder: Path, preset: str, *arguments: str) -> float:
    """Wall seconds of one run of the workflow in `folder`."""
    command = [sys.executable, "-m", "snakemake", *arguments, "--quiet", "all", "--snakefile", REPOSITORY / "Snakefile"]
    command += ["--cores", "all", "--directory", folder, "--config", f"scenes=[{SCENE}]", f"preset={preset}"]
    began = time.perf_counter()
    subprocess.run(list(map(str, command)), check=True, cwd=REPOSITORY)
    return time.perf_counter() - began


def own_s(results: Path, kind: str) -> float:
    """Seconds, "wall_s" or "cpu_s", of all stages from flow to bundle adjustment, over all rounds."""
    stages = ("flow", "motion", "segment", "ba")
    return sum(read_json(file)[kind] for stage in stages for file in results.rglob(f"stats/{stage}.json"))


def describe_error(results: Path) -> str:
    """Camera path error and focal error of the last round, in words."""
    truth = true_cameras(read_sequence(results / "sequence.json"))
    assert truth is not None
    cameras = read_cameras(results / "ba/poses.parquet")
    errors = trajectory.pose_errors(cameras.cam_from_world, truth.cam_from_world, cameras.numbers)
    focal_percent = trajectory.focal_error_percent(cameras.Ks, truth.Ks)
    return f"ATE {errors.ate_percent:.3f} % of path, focal {focal_percent:+.1f} %"


def colmap_seconds(results: Path, folder: Path) -> float:
    """CPU seconds of COLMAP's matching and incremental mapping on the same frames, on one thread."""
    table = folder / "colmap.parquet"
    command = [sys.executable, "-m", "stages.colmap", "--sequence", results / "sequence.json", "--output", table]
    command += ["--mappers", "incremental", "--upsample", "1", "--stats", folder / "colmap.json"]
    command += ["--log", folder / "colmap.log"]
    subprocess.run(list(map(str, command)), check=True, cwd=REPOSITORY)
    variant = read_metadata(table)["variants"][0]
    print(f"COLMAP registered {variant['registered']} of {variant['total']} frames")
    return float(variant["cpu_s"])


def main() -> None:
    """Print seconds, goals and ratios."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        results = folder / "results" / DATASET / SCENE
        run_snakemake(folder, "balanced", "poses")  # renders the frames and fills the cache of compiled kernels
        cpu_s = colmap_seconds(results, folder)
        print(f"{'COLMAP incremental':20s} {cpu_s:6.1f} s CPU, one thread")
        for preset, goal_s in GOALS_S.items():
            shutil.rmtree(results / "round1", ignore_errors=True)  # stages of another preset must not be counted
            own_wall_s = run_snakemake(folder, preset, "poses", "--forcerun", "flow")
            stages_s, own_cpu_s = own_s(results, "wall_s"), own_s(results, "cpu_s")
            threads = read_json(results / "stats/ba.json")["threads"]
            print(
                f"{preset:20s} {own_wall_s:6.1f} s wall ({stages_s:.1f} in stages)  {own_cpu_s:6.1f} s CPU"
                f" on {threads} threads"
                f"  goal {goal_s:.0f} s wall; COLMAP takes {cpu_s / own_cpu_s:.1f} times the CPU time;"
                f" {describe_error(results)}"
            )


if __name__ == "__main__":
    main()
