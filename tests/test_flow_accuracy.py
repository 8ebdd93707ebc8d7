"""The benchmark of flow against truth says in a line each what truth a folder lacks, and never ends in a traceback."""

import shutil
import sys
from pathlib import Path

import finished_run as run
import pytest

from benchmarks import flow_accuracy
from stages.flow.options import FlowOptions


def test_every_kind_of_missing_truth_is_a_line(tmp_path: Path) -> None:
    options = FlowOptions(offsets=(1,))
    blind = run.write_dataset(tmp_path / "blind", truth=False)
    (line,) = flow_accuracy.report(blind, None, options)
    assert line.startswith("final/wall: no true flow in ")
    folder = run.write_dataset(tmp_path)
    complete = flow_accuracy.report(folder, 4, options)
    assert complete[0].startswith("final/wall, 6 edges, ")
    assert complete[1].startswith("  all ")
    assert complete[2].startswith("   1 frames on: error ")
    for kind in ("depth", "camdata_left"):
        shutil.rmtree(tmp_path / "training" / kind)
    _, errors, *missing = flow_accuracy.report(folder, 4, options)
    assert errors == complete[1]
    assert [text.split()[0] for text in missing] == ["camdata_left", "depth"]


def test_a_folder_without_frames_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["flow_accuracy", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit) as ended:
        flow_accuracy.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
