"""Rows in and out of Parquet, where an absent number is a null."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts import read_table, write_table

Row = dict[str, Any]


def write_rows(path: Path, rows: Sequence[Row], columns: Sequence[str], about: Mapping[str, Any]) -> None:
    """Write rows with exactly these columns; None becomes null."""
    write_table(path, {name: [row[name] for row in rows] for name in columns}, about)


def read_rows(path: Path) -> list[Row]:
    """Read rows; null becomes None (the table reader gives NaN, which no score here can be)."""
    table = read_table(path)
    return [{name: _plain(table[name][k]) for name in table} for k in range(len(next(iter(table.values()), [])))]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and np.isnan(value) else value
