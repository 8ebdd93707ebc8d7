"""What a run of the flow stage has done so far, in files beside its output: a killed run goes on from there.

Edges are matched in blocks of frames. A block leaves two files: its flow and confidence as pairs.arrow will hold them,
and, of near and far edges, its flow at full precision, from which longer edges are chained, as long as they need it.
"""

import contextlib
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from stages.flow.edges import Edge
from stages.shared import costs
from stages.shared.artifacts import (
    Dense,
    dense_writer,
    read_dense,
    read_metadata,
    unless_damaged,
    write_dense,
)
from stages.shared.errors import InputError
from stages.shared.packing import Packed
from stages.shared.rows import Rows

ROWS = 64
"""Edges that are copied together."""
KINDS = ("near", "far", "loop")


class Window(Mapping[Edge, np.ndarray]):
    """Flow [h, w, 2] px, float32, of the edges that end in the latest blocks, read from their files.

    An edge ends at the later of its frames.
    """

    def __init__(self, most: int | None = None) -> None:
        """Of which the memory is given back after `most` edges were read; None: where it is released alone."""
        self._blocks: dict[int, tuple[Path, Dense]] = {}
        self._rows: dict[Edge, tuple[int, int]] = {}
        self._most, self._read = most, 0

    def add(self, run: range, path: Path) -> None:
        """Take in the file of the edges that end in the frames `run`."""
        self._blocks[run.stop] = path, (columns := read_dense(path))
        for row, edge in enumerate(_edges(columns)):
            self._rows[edge] = run.stop, row

    def drop(self, before: int) -> None:
        """Delete the files of the blocks that end before this frame."""
        for stop in [stop for stop in self._blocks if stop <= before]:
            self._blocks.pop(stop)[0].unlink(missing_ok=True)  # another run may have removed it
        self._rows = {edge: place for edge, place in self._rows.items() if place[0] > before}

    def release(self) -> None:
        """Give back the memory of what was read."""
        for _, columns in self._blocks.values():
            columns.release(keep_short=False)

    def __getitem__(self, edge: Edge) -> np.ndarray:
        stop, row = self._rows[edge]
        self._read += 1
        if self._most is not None and self._read % self._most == 0:
            self.release()
        return self._blocks[stop][1]["flow"][row].astype(np.float32, copy=False)

    def __contains__(self, edge: object) -> bool:
        return edge in self._rows

    def __iter__(self) -> Iterator[Edge]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


class Parts:
    """The files of a run beside its output. Only a run of the same origin goes on from them.

    Attributes:
        windows: of near and of far edges, from which others are chained.
    """

    def __init__(self, output: Path, origin: str) -> None:
        self.folder = output.with_name(f".{output.name}.parts")
        costs.goes_on(self.folder, origin)
        costs.begin(self.folder, origin)
        self.windows = {kind: Window() for kind in ("near", "far")}
        self._done: dict[str, set[Path]] = {kind: set() for kind in KINDS}

    def resume(self, kind: str, run: range) -> int | None:
        """Take over a block of edges that an earlier run has finished; their number, None if there is none."""
        done, exact = self._file(kind, run), self._exact(kind, run)
        if not done.exists():
            return None

        def take() -> int:
            edges = int(read_metadata(done)["edges"])
            if exact.exists():
                self.windows[kind].add(run, exact)
            self._done[kind].add(done)
            return edges

        return unless_damaged(take)

    def add(
        self, kind: str, run: range, edges: Mapping[Edge, np.ndarray], packed: Mapping[str, Packed], **facts: int
    ) -> None:
        """Keep a block of edges with their flow [h, w, 2] px, as it is and packed, and facts that add up."""
        if edges and kind in self.windows:
            write_dense(self._exact(kind, run), {**_ends(list(edges)), "flow": np.stack(list(edges.values()))})
            self.windows[kind].add(run, self._exact(kind, run))
        columns = {**_ends(list(edges)), **packed} if edges else {"source": np.zeros(0, np.int64)}
        write_dense(self._file(kind, run), columns, {"edges": len(edges), **facts})
        self._done[kind].add(self._file(kind, run))
        costs.keep(self.folder)

    def kept(self, kind: str) -> Window:
        """Flow of all edges of a kind that are done, as pairs.arrow will hold it, of which ROWS at most are held."""
        window = Window(ROWS)
        for n, path in enumerate(self._finished([kind])):
            if read_metadata(path)["edges"]:
                window.add(range(n, n + 1), path)
        return window

    def totals(self) -> dict[str, Any]:
        """The sums of the facts over all blocks."""
        sums: dict[str, Any] = {}
        for path in self._finished():
            about = {key: n for key, n in read_metadata(path).items() if key not in ("format_version", "code")}
            sums |= {key: sums.get(key, 0) + n for key, n in about.items()}
        return sums

    def join(self, output: Path, metadata: Mapping[str, Any]) -> None:
        """Write the edges of all blocks to pairs.arrow, sorted by source and target."""
        files = [file for file in map(read_dense, self._finished()) if "flow" in file]
        rows = sorted((edge, k, row) for k, file in enumerate(files) for row, edge in enumerate(_edges(file)))
        with dense_writer(output, metadata) as write:
            for first in range(0, len(rows), ROWS):
                some = rows[first : first + ROWS]
                columns = _ends([edge for edge, _, _ in some])
                for name in ("flow", "confidence"):
                    of_files = [cast(Rows, file[name]) for file in files]
                    columns[name] = Packed([of_files[k].packed[row] for _, k, row in some], of_files[0].shape[1:])
                write(columns)
                for k in {k for _, k, _ in some}:
                    files[k].release()

    def remove(self) -> None:
        """Delete the files, unless another run has: this run is done."""
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(self.folder)

    def _finished(self, kinds: Iterable[str] = KINDS) -> list[Path]:
        """The files of all blocks, in order.

        Raises:
            InputError: if some are gone: a run whose workflow was killed may have lived on, ended, and removed them.
        """
        found = [path for kind in kinds for path in sorted(self._done[kind])]
        if gone := sum(not path.exists() for path in found):
            kept, advice = f"the {len(found)} blocks that are done", "end any other run of this stage, and run it again"
            raise InputError(self.folder, kept, f"{gone} of them removed", advice)
        return found

    def _file(self, kind: str, run: range) -> Path:
        return self.folder / f"{kind}_{run.start:06d}.arrow"

    def _exact(self, kind: str, run: range) -> Path:
        return self.folder / f"exact_{kind}_{run.start:06d}.arrow"


def _edges(columns: Mapping[str, np.ndarray]) -> list[Edge]:
    return list(zip(columns["source"].tolist(), columns["target"].tolist(), strict=True))


def _ends(edges: list[Edge]) -> dict[str, Any]:
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    return {"source": source, "target": target}
