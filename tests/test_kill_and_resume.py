"""The benchmark of kills: a stage is killed on the way, started again, and what that cost is told from its times."""

import sys
from pathlib import Path

import pytest

from benchmarks import kill_and_resume
from stages.shared import chain
from stages.shared.artifacts import write_json

STAGE = """
import json, os, sys, time
from pathlib import Path
kept, spent = Path("kept.json"), 0.0
taken_over = json.loads(kept.read_text()) if kept.exists() else 0.0
with open("runs.txt", "a") as runs:
    runs.write(f"{taken_over:.1f}\\n")
while taken_over + spent < 2.0:
    time.sleep(0.1)
    spent += 0.1
    Path("kept.partial").write_text(json.dumps(taken_over + spent))
    os.replace("kept.partial", kept)
Path(sys.argv[2]).write_text(json.dumps({"wall_s": taken_over + spent, "taken_over_s": taken_over}))
"""
"""Takes two seconds in steps, each of which it keeps."""
WORKFLOW = """
import subprocess, sys
folder, stats = sys.argv[1:3]
sys.exit(subprocess.run([sys.executable, "-c", sys.argv[3], "--stats", stats], cwd=folder).returncode)
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run whose workflow runs STAGE."""

    def command_of(folder: Path, _: object, *words: str) -> list[str]:
        return [sys.executable, "-c", WORKFLOW, str(folder), words[2], STAGE]

    monkeypatch.setattr(kill_and_resume, "command_of", command_of)
    home = tmp_path / "results/clip/clip"
    write_json(home / "stats/ba.json", {"wall_s": 2.0})
    write_json(tmp_path / "options.json", {})
    return home


def test_a_killed_stage_goes_on_and_its_times_are_put_back(home: Path) -> None:
    folder, before = home.parents[2], (home / "stats/ba.json").read_bytes()
    whole_s, killed_s, resumed_s = kill_and_resume.lost(folder, home, "ba", 0.5, [])
    begun = [float(line) for line in (folder / "runs.txt").read_text().split()]
    assert whole_s == 2.0
    assert killed_s >= 1.0
    assert begun[0] == 0
    assert 0 < begun[1] < 2.0, "killed on its way"
    assert resumed_s == pytest.approx(2.0 - begun[1], abs=0.15)
    assert (home / "stats/ba.json").read_bytes() == before


def test_a_stage_that_ends_before_the_kill_is_an_error(home: Path) -> None:
    with pytest.raises(SystemExit, match="ended before it was killed"):
        kill_and_resume.lost(home.parents[2], home, "ba", 2.0, [])


def test_no_stage_runs_again_because_of_one_that_was_killed_before() -> None:
    assert list(kill_and_resume.STAGES) == sorted(kill_and_resume.STAGES, key=chain.STAGES.index, reverse=True)
