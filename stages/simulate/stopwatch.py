"""Wall-clock seconds by name; time inside a nested measurement counts for the inner name alone."""

import contextlib
import time
from collections.abc import Iterator


class Stopwatch:
    """Measures blocks of code.

    Attributes:
        spent: wall-clock seconds by name. calls: number of measurements by name.
    """

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self._open: list[str] = []
        self._since = time.perf_counter()

    @contextlib.contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time of the block to `name`."""
        self._settle()
        self._open.append(name)
        self.calls[name] = self.calls.get(name, 0) + 1
        self.spent.setdefault(name, 0.0)
        try:
            yield
        finally:
            self._settle()
            self._open.pop()

    def _settle(self) -> None:
        """Add the time since the last call to the innermost open name."""
        now = time.perf_counter()
        if self._open:
            self.spent[self._open[-1]] += now - self._since
        self._since = now
