"""Provenance of the numbers: versions, commit, machine, options, and hashes of inputs and predictions."""

import datetime
import hashlib
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_json
from stages.shared.digest import ROOT
from stages.shared.tables import Column, Row, Table

PACKAGES = (
    "motionsplat",
    "numpy",
    "scipy",
    "numba",
    "opencv-contrib-python-headless",
    "torch",
    "pycolmap",
    "snakemake",
)
WRITTEN = ("README.md", "docs")
"""Files that commands such as `make results` write; changes of them do not count as local changes."""
PREDICTIONS = ("ba/poses.parquet", "masks", "gaussians/gaussians.ply", "gaussians/model.safetensors", "renders")


def tables(folders: Sequence[Path]) -> list[Table]:
    """The tables of provenance for the result folders of the sequences: run, options, hashes."""
    run = [{"what": what, "value": value} for what, value in about_run().items()]
    hashes = [{"sequence": folder.name} | row for folder in folders for row in hashes_of(folder)]
    options = Column("stage", "stage"), Column("sequences", "sequences"), Column("options", "options", long=True)
    what, sequence = Column("what", "what"), Column("sequence", "sequence")
    digits = Column("sha256", "SHA-256 (first 16 digits)")
    return [
        Table(
            "run",
            "This report",
            "As found when this page was written.",
            (what, Column("value", "value", long=True)),
            run,
        ),
        Table(
            "options", "Options of every stage", "Of the last round of repeated stages.", options, option_rows(folders)
        ),
        Table(
            "hashes",
            "Inputs and predictions",
            "Over file contents, in order of names.",
            (sequence, what, digits),
            hashes,
        ),
    ]


def option_rows(folders: Sequence[Path]) -> list[Row]:
    """The options of every stage, from the time files; sequences with equal options share a row."""
    found: dict[tuple[str, str], list[str]] = {}
    for folder in folders:
        for path in sorted((folder / "stats").glob("*.json")):
            options = read_json(path).get("options", {})
            text = ", ".join(f"{name} = {value}" for name, value in options.items())
            found.setdefault((path.stem, text or "none"), []).append(folder.name)
    return [
        {"stage": stage, "sequences": "all" if len(names) == len(folders) else ", ".join(names), "options": text}
        for (stage, text), names in sorted(found.items())
    ]


def about_run() -> dict[str, str]:
    """Date, commit, versions and machine of this report."""
    return {
        "written": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit(),
        "versions": ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        "Python": platform.python_version(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {_memory_gb()} GB, {platform.system()}",
    }


def commit() -> str:
    """The git commit of this code, with "and local changes" if tracked files other than WRITTEN differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        changed = git("status", "--porcelain", "-uno", "--", ":/", *(f":(exclude,top){path}" for path in WRITTEN))
        return git("rev-parse", "HEAD") + (" and local changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown (not a git checkout)"


def hashes_of(folder: Path) -> list[Row]:
    """SHA-256 (16 digits) of the input frames and of every existing prediction of a sequence."""
    frames: Any = read_json(folder / "sequence.json").get("frames_sha256")
    rows = [{"what": "input frames (pixels)", "sha256": str(frames)[:16]}] if frames else []
    for name in PREDICTIONS:
        path = folder / name
        if path.exists():
            files = sorted(path.rglob("frame_*.png")) if path.is_dir() else [path]
            rows.append({"what": name, "sha256": sha256(files)[:16]})
    return rows


def sha256(files: Sequence[Path]) -> str:
    """SHA-256 over the contents of files, in order, as hexadecimal digits."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"


def _memory_gb() -> int:
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
