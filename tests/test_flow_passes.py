"""Flow of a long clip in passes: the same as matching all edges at once, and resumed where a killed run has stopped."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_flow import shifted_frames

from stages.flow import __main__ as flow_stage
from stages.flow import edges, passes
from stages.flow.averaging import _average
from stages.flow.dis import estimate_flow
from stages.flow.frames import Images
from stages.flow.loops import Loop
from stages.flow.options import FlowOptions
from stages.flow.parts import ROWS, Parts, Window
from stages.shared import costs, digest
from stages.shared.artifacts import read_dense, read_metadata, write_json
from stages.shared.errors import InputError
from stages.shared.packing import Packed, pack
from stages.shared.sequences import check_sequence, sequence_to_json

KILLED = """
import os, signal, sys
from pathlib import Path
from stages.flow import __main__ as stage, parts
from stages.shared import costs
add, added = parts.Parts.add, []
def killing(self, *block, **facts):
    add(self, *block, **facts)
    added.append(block)
    if len(added) == 3:
        (folder / "spent").write_text(str(costs.spent()["wall_s"]))
    if len(added) == 4:
        os.kill(os.getpid(), signal.SIGKILL)
parts.Parts.add = killing
folder = Path(sys.argv[1])
stage.main(folder / "sequence.json", folder / "pairs.arrow", folder / "flow.png", stage.FlowOptions(offsets=(1, 2)))
"""


def write_clip(folder: Path, T: int) -> np.ndarray:
    """Grey frames [T, h, w] of a texture that moves, as a sequence in the folder."""
    grey = shifted_frames(T, (1, 0), (48, 96))
    (folder / "clip").mkdir(parents=True)
    for k, frame in enumerate(grey):
        cv2.imwrite(str(folder / "clip" / f"frame_{k + 1:04d}.png"), frame)
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("clip", folder / "clip")))
    return grey


def run(folder: Path, options: FlowOptions) -> bytes:
    """The content of pairs.arrow."""
    flow_stage.main(folder / "sequence.json", folder / "pairs.arrow", folder / "flow.png", options)
    return (folder / "pairs.arrow").read_bytes()


def test_passes_find_what_matching_all_edges_at_once_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, and though flow is forgotten when no longer edge can start from it."""
    monkeypatch.setattr(edges, "LADDER", (8, 12))
    monkeypatch.setattr(passes, "LADDER", (8, 12))
    held = []
    resume = Parts.resume
    monkeypatch.setattr(Parts, "resume", lambda *at: held.append(len(list(tmp_path.rglob("exact_*")))) or resume(*at))
    grey, options = write_clip(tmp_path, 44), FlowOptions(offsets=(1, 3))
    run(tmp_path, options)
    near = estimate_flow(grey, edges.edge_list(44, (1, 3)), 0, 2)
    far = edges.long_edges(near, 44, 2)
    everything = near | estimate_flow(grey, far, 0, 2, near)
    found = read_dense(tmp_path / "pairs.arrow")
    ends = list(zip(found["source"].tolist(), found["target"].tolist(), strict=True))
    assert ends == sorted(everything)
    assert read_metadata(tmp_path / "pairs.arrow")["long_edges"] == len(far) / 2 > 50
    for row, edge in enumerate(ends):
        np.testing.assert_array_equal(found["flow"][row], passes.stored(everything[edge]), err_msg=str(edge))
    assert max(held) <= 8  # of twelve blocks, or any number
    assert not list(tmp_path.glob(".*"))


def test_a_killed_run_resumes_with_the_same_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SIGKILL after four of six blocks: two are left, and the file is that of a run in one go."""
    options = FlowOptions(offsets=(1, 2))
    write_clip(tmp_path / "whole", 20)
    expected = run(tmp_path / "whole", options)
    write_clip(tmp_path / "killed", 20)
    killed = subprocess.run([sys.executable, "-c", KILLED, tmp_path / "killed"], check=False, env=os.environ)
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed/pairs.arrow").exists()
    added = []
    add = Parts.add
    monkeypatch.setattr(Parts, "add", lambda *block, **facts: added.append(block[1:3]) or add(*block, **facts))
    assert run(tmp_path / "killed", options) == expected
    assert added == [("far", range(8, 16)), ("far", range(16, 20))]
    assert costs.spent()["taken_over_s"] > float((tmp_path / "killed/spent").read_text())
    assert not list((tmp_path / "killed").glob(".*"))


@pytest.mark.parametrize("kind", ["done", "exact"])
def test_a_block_that_a_power_cut_has_damaged_is_matched_again(tmp_path: Path, kind: str) -> None:
    flow = {(0, 1): np.ones((8, 12, 2), np.float32), (1, 0): -np.ones((8, 12, 2), np.float32)}
    packed = {"flow": Packed([pack(values) for values in flow.values()], (8, 12, 2))}
    parts = Parts(tmp_path / "pairs.arrow", "here")
    parts.add("near", range(8), flow, packed)
    files = {"done": parts._file("near", range(8)), "exact": parts._exact("near", range(8))}
    assert Parts(tmp_path / "pairs.arrow", "here").resume("near", range(8)) == 2
    files[kind].write_bytes(files[kind].read_bytes()[:100])
    again = Parts(tmp_path / "pairs.arrow", "here")
    assert again.resume("near", range(8)) is None
    again.add("near", range(8), flow, packed)
    assert Parts(tmp_path / "pairs.arrow", "here").resume("near", range(8)) == 2


def test_blocks_that_another_run_removes_are_missed(tmp_path: Path) -> None:
    """A killed workflow leaves its stage running: that one ends while the next run works on the same blocks."""
    flow = {(0, 1): np.ones((8, 12, 2), np.float32)}
    packed = {name: Packed([pack(flow[0, 1])], (8, 12, 2)) for name in ("flow", "confidence")}
    left = Parts(tmp_path / "pairs.arrow", "here")
    left.add("near", range(8), flow, packed)
    parts = Parts(tmp_path / "pairs.arrow", "here")
    assert parts.resume("near", range(8)) == 1
    left.remove()
    parts.add("near", range(8, 16), flow, packed)
    parts.windows["near"].drop(8)
    for reads in (parts.totals, lambda: parts.kept("near"), lambda: parts.join(tmp_path / "pairs.arrow", {})):
        with pytest.raises(InputError, match="2 blocks that are done, found 1 of them removed"):
            reads()
    assert not (tmp_path / "pairs.arrow").exists()


def test_a_killed_averaging_resumes_with_the_same_frames(tmp_path: Path) -> None:
    """Fast noisy frames, of whose four blocks a killed run has left some: flow of two steps starts from that of one."""
    noise = np.random.default_rng(0).normal(0, 6, (28, 48, 96))
    loud = Images(28, (shifted_frames(28, (4, 1), (48, 96)) + noise).astype(np.float32).__getitem__)
    files = _average(loud, 36.0, 0, 2, tmp_path)
    expected = [path.read_bytes() for path in files]
    for left in (1, 2, 3):
        for path in [*files[left:], tmp_path / costs.SPENT]:
            path.unlink()
        _average(loud, 36.0, 0, 2, tmp_path)
        assert [path.read_bytes() for path in files] == expected, left
        assert (tmp_path / costs.SPENT).exists(), left
    files[1].write_bytes(expected[1][:200])  # by a power cut
    _average(loud, 36.0, 0, 2, tmp_path)
    assert [path.read_bytes() for path in files] == expected


def test_only_the_same_run_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other options, frames or code start anew."""
    frame, output = tmp_path / "frame_0001.png", tmp_path / "pairs.arrow"
    frame.write_bytes(b"one")
    origins = [digest.origin("stages.flow", [frame], FlowOptions())] * 2
    origins.append(digest.origin("stages.flow", [frame], FlowOptions(finest_scale=1)))
    frame.write_bytes(b"two")
    origins.append(digest.origin("stages.flow", [frame], FlowOptions(finest_scale=1)))
    monkeypatch.setattr(digest, "code_digest", lambda module: f"{module}, changed")
    origins.append(digest.origin("stages.flow", [frame], FlowOptions(finest_scale=1)))
    resumed = []
    for origin in origins:
        parts = Parts(output, origin)
        resumed.append((parts.folder / "near_000000.arrow").exists())
        (parts.folder / "near_000000.arrow").touch()
    assert resumed == [False, True, False, False, False]


def test_all_near_flow_is_read_without_holding_it(tmp_path: Path) -> None:
    """Loops are sought in a thousand frames: of edges that were read, few stay in memory."""
    parts, rng = Parts(tmp_path / "pairs.arrow", "here"), np.random.default_rng(0)
    flow = {(k, k + 1): rng.normal(size=(4, 6, 2)).astype(np.float16) for k in range(3 * ROWS)}
    for first in range(0, len(flow), 8):
        block = dict(list(flow.items())[first : first + 8])
        packed = {"flow": Packed([pack(of) for of in block.values()], (4, 6, 2))}
        parts.add("near", range(first, first + 8), block, packed)
    kept = parts.kept("near")
    unpacked = [columns["flow"]._read for _, columns in kept._blocks.values()]  # type: ignore[attr-defined]
    for edge, of in flow.items():
        np.testing.assert_array_equal(kept[edge], of)
        assert sum(rows.cache_info().currsize for rows in unpacked) <= ROWS


def test_loops_are_matched_a_block_at_a_time_and_resumed(tmp_path: Path) -> None:
    """Twenty loops in three blocks, of which a killed run has left the first; flow is packed when a block is done."""
    pairs = [(k, k + 70) for k in range(20)]

    class Matched:
        """Knows loops, and the flow of those that it is asked for."""

        def __init__(self) -> None:
            self.asked: list[int] = []

        def loops(self, _near: Window, _scene: None) -> list[Loop]:
            return [Loop(pair, np.zeros((0, 2, 2))) for pair in pairs]

        def closed(self, loops: list[Loop]) -> dict[edges.Edge, np.ndarray]:
            self.asked.append(len(loops))
            both = [edge for loop in loops for edge in (loop.pair, loop.pair[::-1])]
            return {(i, j): np.full((4, 6, 2), i + j / 100, np.float32) for i, j in both if max(i, j) != 75}

        def confidence(self, edge: edges.Edge, flow: passes.Flows) -> np.ndarray:
            return np.ones(flow[edge].shape[:2])

    first, again = Matched(), Matched()
    parts = Parts(tmp_path / "pairs.arrow", "here")
    facts = passes.close_loops(first, 90, parts, None)  # type: ignore[arg-type]
    assert facts == {"loops": 19, "frames_in_loops": 38}
    (parts.folder / "loop_000008.arrow").unlink()
    assert passes.close_loops(again, 90, parts, None) == facts  # type: ignore[arg-type]
    assert (first.asked, again.asked) == ([8, 8, 4], [8])
    assert not list(parts.folder.glob("exact_*"))
    kept = parts.kept("loop")
    assert sorted(kept) == sorted(edge for i, j in pairs if j != 75 for edge in ((i, j), (j, i)))
    assert all((kept[i, j] == passes.stored(np.full((4, 6, 2), i + j / 100, np.float32))).all() for i, j in kept)
