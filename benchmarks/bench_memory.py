"""Memory that every stage asks for against what it uses, on a clip of any length and size.

Run as `python -m benchmarks.bench_memory --frames 300 --width 1920 --height 1080`; without options on 30 frames of
512 x 218 px, which takes three CPU minutes. Further words go to Snakemake, as
`--until control`, which stops before the training. `--folder` keeps what was made.

The clip is the demo scene, drawn small, enlarged, and played forward and back: cameras and movers are real, and no more
than DISTINCT frames are drawn. Optimisations take few steps, as what they hold does not grow with them (measured, see
stages/shared/memory.py). A stage misses if it uses more than it asks for at its first attempt, or asks for more than
MOST times what it used and SMALL_MB more: the exit code is then 1.
"""

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import yaml

from stages.shared.artifacts import read_json
from stages.shared.images import read_rgb, write_image

REPO = Path(__file__).parents[1]
SCENE = REPO / "stages/simulate/scenes/demo.yaml"
DISTINCT, DRAWN_PX = 30, 512
MOST, SMALL_MB = 1.3, 200
"""Of asked over used; and how many megabytes more than used anybody may ask for."""
CLIP = "clip"
OPTIONS = {"control": {"steps": 5}, "gaussians": {"steps": 5}}
MIB = 2**20 / 1e6
"""Megabytes of those in which `peak_mb` counts."""


def draw_frames(folder: Path, scene: Mapping[str, object], width: int, height: int) -> list[Path]:
    """Frames of a scene in the shape of `width` x `height`, drawn at most DRAWN_PX wide."""
    share = min(1.0, DRAWN_PX / width)
    size = {"width": round(width * share), "height": round(height * share)}
    (folder / f"{CLIP}.yaml").write_text(yaml.safe_dump({**scene, **size}))
    drawing = [sys.executable, "-m", "stages.simulate", "--scene", folder / f"{CLIP}.yaml", "--output", folder]
    subprocess.run(list(map(str, drawing)), cwd=REPO, check=True)
    return sorted((folder / "training/final" / CLIP).glob("*.png"))


def enlarge(frames: Iterable[Path], width: int, height: int) -> None:
    """Write the frames again at this size."""
    for path in frames:
        write_image(path, np.asarray(cv2.resize(read_rgb(path), (width, height), interpolation=cv2.INTER_CUBIC)))


def make_clip(folder: Path, count: int, width: int, height: int) -> Path:
    """A folder of `count` frames, at most DISTINCT of them drawn, then back and forth; kept where it is complete."""
    clip = folder / CLIP
    if len(list(clip.glob("*.png"))) != count:
        clip.mkdir(parents=True, exist_ok=True)
        scene = yaml.safe_load(SCENE.read_text()) | {"frames": min(count, DISTINCT), "effects": {}}
        drawn = draw_frames(folder, scene, width, height)
        if width > DRAWN_PX:
            enlarge(drawn, width, height)
        there_and_back = [*range(len(drawn)), *range(len(drawn) - 2, 0, -1)]
        for k in range(count):
            os.link(drawn[there_and_back[k % len(there_and_back)]], clip / f"frame_{k + 1:04d}.png")
    return clip


def command_of(folder: Path, options: Mapping[str, object], *words: str) -> list[str]:
    """The command that runs the workflow in `folder` with these options, which it writes there."""
    file = folder / "options.json"
    file.write_text(json.dumps(options))
    command = [sys.executable, "-m", "snakemake", *words, "--snakefile", REPO / "Snakefile", "--directory", folder]
    return [*map(str, command), "--configfile", str(file)]


def snakemake(folder: Path, options: Mapping[str, object], *words: str) -> str:
    """Run the workflow in `folder` with these options; what it printed on stdout."""
    command = command_of(folder, options, *words)
    done = subprocess.run(command, cwd=REPO, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout[-4000:]}\nsnakemake failed: its folder is {folder}")
    return done.stdout


def asked_mb(folder: Path, options: Mapping[str, object], words: list[str]) -> dict[str, int]:
    """Megabytes (1e6 bytes) that the job of each rule asks for at its first attempt, from a dry run of all."""
    jobs = re.split(r"^ *(?=rule \w+:)", snakemake(folder, options, "-n", "-F", *words), flags=re.MULTILINE)[1:]
    found = {job.partition(":")[0].removeprefix("rule "): re.search(r"\bmem_mb=(\d+)", job) for job in jobs}
    return {rule: int(asked[1]) for rule, asked in found.items() if asked}


def used_mb(folder: Path) -> dict[str, float]:
    """The largest peak of each stage over its rounds, in megabytes (1e6 bytes)."""
    peaks: dict[str, float] = {}
    for file in sorted((folder / "results").rglob("stats/*.json")):
        spent = read_json(file)
        peaks[file.stem] = max(peaks.get(file.stem, 0), spent["peak_mb"] * MIB)
    return peaks


def misses(asked: float, used: float) -> bool:
    """Whether a stage asks for too little or far too much."""
    return asked < used or asked > max(MOST * used, used + SMALL_MB)


@contextlib.contextmanager
def in_folder(folder: Path | None) -> Iterator[Path]:
    """The folder to work in: the one named, or one that goes with the block."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder.absolute()
        return
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def main() -> None:
    """Print asked, used and their ratio for every stage that ran; exit code 1 if any misses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--width", type=int, default=512, help="pixels")
    parser.add_argument("--height", type=int, default=218, help="pixels")
    parser.add_argument("--folder", type=Path, help="where to work, and to keep what was made (default: nowhere)")
    given, words = parser.parse_known_args()
    with in_folder(given.folder) as folder:
        make_clip(folder, given.frames, given.width, given.height)
        options = {"dataset": str(folder / CLIP), **OPTIONS}
        snakemake(folder, options, "--cores", "all", *words)
        asked, used = asked_mb(folder, options, words), used_mb(folder)
    print(f"{given.frames} frames of {given.width} x {given.height} px; megabytes of 1e6 bytes")
    missed = []
    for stage in sorted(asked.keys() & used):
        ratio = asked[stage] / used[stage]
        missed += [stage] if misses(asked[stage], used[stage]) else []
        note = "  MISSES" if stage in missed else ""
        print(f"{stage:14s} asked {asked[stage]:7d}  used {used[stage]:7.0f}  ratio {ratio:5.2f}{note}")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
