"""Tables of the report: columns with label, unit and digits; rows as Parquet, CSV and Markdown."""

import base64
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts import read_table, write_table
from stages.shared.atomic import atomic

Row = dict[str, Any]
MAX_DIGITS = 6
WRAPPED = 20
"""Texts with more characters than this may be broken into lines."""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        key: name in the rows and in the files.
        label, unit: the heading.
        digits: after the point, or more if a value needs them for two significant ones; None for text and counts.
        bar: whether each value is also drawn as a bar.
        long: whether the cells are sentences, shown in small type.
        file_only: whether the column is in the CSV and Parquet copies alone, not on the page.
    """

    key: str
    label: str
    unit: str = ""
    digits: int | None = None
    bar: bool = False
    long: bool = False
    file_only: bool = False

    def show(self, row: Row) -> str:
        """The cell as text; "n/a" for an unknown number."""
        value = row.get(self.key)
        if value is None or value == "":
            return "n/a" if self.digits is not None else ""
        if self.digits is None:
            return f"{value:.4g}" if isinstance(value, float) else str(value)
        return decimal(value, self.digits)

    def style(self, rows: Sequence[Row]) -> str:
        """The CSS class of the cells in these rows: "number", "long", "words" or "text"."""
        values = [row.get(self.key) for row in rows]
        if self.digits is not None or any(isinstance(value, int | float) for value in values):
            return "number"
        if self.long:
            return "long"
        return "words" if max((len(str(value)) for value in values), default=0) > WRAPPED else "text"

    def share(self, row: Row, highest: float) -> float | None:
        """Length of the bar in percent of the highest value; None for totals and unknown values."""
        value = row.get(self.key)
        return 100 * value / highest if value is not None and highest > 0 and not row.get("is_total") else None

    def sort_key(self, row: Row) -> str:
        """The value by which the page sorts: the unrounded number, or the text."""
        value = row.get(self.key)
        return "" if value is None else str(value)


@dataclass(frozen=True)
class Table:
    """A table of the report.

    Attributes:
        name: file name of its copies. note: protocol, shown below the title.
    """

    name: str
    title: str
    note: str
    columns: tuple[Column, ...]
    rows: list[Row]

    @property
    def shown(self) -> tuple[Column, ...]:
        """The columns of the page: those with values, without the sequence's name if there is only one."""
        return tuple(column for column in self.columns if not column.file_only and self._says_something(column))

    def _says_something(self, column: Column) -> bool:
        values = {row.get(column.key) for row in self.rows} - {None, ""}
        return len(values) > 1 if column.key == "sequence" else bool(values)

    def highest(self, column: Column) -> float:
        """Largest value of a column, without totals; 0 if all are unknown."""
        values = [row.get(column.key) for row in self.rows if not row.get("is_total")]
        return max((value for value in values if value is not None), default=0.0)

    def csv(self) -> str:
        """The table as CSV with all digits; the header holds keys with units."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([f"{c.key} [{c.unit}]" if c.unit else c.key for c in self.columns])
        writer.writerows([row.get(c.key) for c in self.columns] for row in self.rows)
        return text.getvalue()

    def csv_uri(self) -> str:
        """The CSV as a data URI, which makes the page self-contained."""
        return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(self.csv().encode()).decode()}"

    def markdown(self) -> str:
        """Heading and rows as a Markdown table, without title and note."""
        columns = self.shown
        lines = [
            [f"{c.label}, {c.unit}" if c.unit else c.label for c in columns],
            ["---:" if c.style(self.rows) == "number" else "---" for c in columns],
            *([c.show(row).replace("|", "/") for c in columns] for row in self.rows),
        ]
        return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)

    def of(self, sequence: str) -> "Table":
        """The rows of one sequence, without the column that names it."""
        columns = tuple(column for column in self.columns if column.key != "sequence")
        rows = [row for row in self.rows if row["sequence"] == sequence]
        return Table(f"{self.name}_{sequence}", self.title, self.note, columns, rows)

    def write(self, folder: Path) -> None:
        """Write `<name>.csv` and `<name>.parquet`."""
        with atomic(folder / f"{self.name}.csv") as partial:
            partial.write_text(self.csv())
        units = {column.key: column.unit for column in self.columns}
        keys = [column.key for column in self.columns]
        about = {"title": self.title, "protocol": self.note, "units": units}
        rows = [{key: row.get(key) for key in keys} for row in self.rows]
        write_rows(folder / f"{self.name}.parquet", rows, keys, about)


def decimal(value: float, digits: int) -> str:
    """`value` with `digits` digits after the point, or more, up to 6, if two significant ones need them."""
    needed = 1 - math.floor(math.log10(abs(value))) if 0 < abs(value) < 1 else 0
    return f"{value:.{needed if digits < needed <= MAX_DIGITS else digits}f}"


def write_rows(path: Path, rows: Sequence[Row], columns: Sequence[str], about: Mapping[str, Any]) -> None:
    """Write rows with exactly these columns; None becomes null."""
    write_table(path, {name: [row[name] for row in rows] for name in columns}, about)


def read_rows(path: Path) -> list[Row]:
    """Read rows; null becomes None. (The table reader returns NaN for it; no score is NaN.)"""
    table = read_table(path)
    return [{name: _plain(table[name][k]) for name in table} for k in range(len(next(iter(table.values()), [])))]


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and np.isnan(value) else value
