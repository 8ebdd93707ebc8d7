"""The tables of the report on what single parts of the method change, sequence by sequence."""

from collections.abc import Sequence

from stages.comparisons import paired
from stages.report.tradeoff_report import TITLES
from stages.shared.tables import Column, Row, Table

GROUPS = ("claims", "effects")
"""Groups of the sweep whose runs are compared with the configured one sequence by sequence."""
NOTE = (
    "Change from the configured run to this one, paired by sequence: mean, and in brackets its "
    f"{100 * paired.LEVEL:.0f} % interval (Student), from {paired.FEWEST} sequences on. Factors are geometric means of "
    "this run over the configured one: above 1 this run has more of it. ATE is compared where both runs have poses of "
    "all frames."
)
COLUMNS = (
    Column("setting", "setting"),
    Column("sequences", "sequences"),
    *(Column(effect.key, effect.label, effect.unit) for effect in paired.EFFECTS),
)


def paired_tables(costs: Sequence[Row]) -> list[Table]:
    """The change that each run of a group brings, with its interval, if several sequences were swept.

    Args:
        costs: rows of the sweep's table, one per sequence and setting.
    """
    if len({row["sequence"] for row in costs}) < 2:
        return []
    found = {group: paired.paired(costs, group) for group in GROUPS}
    title = "change from the configured run"
    return [
        Table(f"paired_{group}", f"{TITLES[group]}: {title}", NOTE, COLUMNS, rows)
        for group, rows in found.items()
        if rows
    ]
