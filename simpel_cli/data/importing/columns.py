"""The columns of files that nobody has described yet: numbers or texts, constant or not, jumps, angles that wrap."""

import math
from typing import NamedTuple

import numpy as np

from simpel_cli.data.checks.units import read_card
from simpel_cli.data.tables.formats.csv_header import is_number
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import DataError

JUMP = 20.0  # times the step that 95 % of the others do not exceed
FEW = 0.03  # of the steps; more are no jumps, but how the column is
TURNS = {2 * math.pi: "rad", 360.0: "degrees"}
LEVELS = 10  # a switch, a gear, a step of an input
NEARLY = 0.1  # of a turn, between the ends of an angle that wraps
WRAP = 0.7  # of a turn, at least, where it does
PATIENCE = 0.5  # share of the entries that are numbers, above which a column of texts is one of numbers with faults


class Column(NamedTuple):
    """One column.

    Args:
        name: to address it by.
        unit: as the file or its card says; empty: they do not.
        values: numbers, (n,); None: it holds texts.
        remarks: what is odd about it.
        questions: what only a person can tell.
    """

    name: str
    unit: str
    values: np.ndarray | None
    remarks: tuple[str, ...]
    questions: tuple[str, ...]

    @property
    def constant(self) -> bool:
        """Whether it never changes."""
        return self.values is not None and bool(np.nanmax(self.values) == np.nanmin(self.values))


def columns_of(table: Table) -> list[Column]:
    """Look at every column of a table, without its jumps: they are told once it is known where episodes begin.

    Raises:
        DataError: none of them holds numbers.
    """
    units: dict[str, str] = {}
    for sheet in table.sheets:
        units = read_card(sheet.path)[0] | sheet.units | units
    found = [_column(table, name, units.get(name, "")) for name in table.columns]
    if all(column.values is None for column in found):
        raise DataError(f"{table.name}: none of its columns holds numbers (it has: {', '.join(table.columns)}).")
    return found


def with_jumps(columns: list[Column], starts: np.ndarray) -> list[Column]:
    """Say which columns jump within an episode.

    Args:
        columns: of numbers and texts.
        starts: rows at which an episode begins, (k,).
    """
    done = []
    for column in columns:
        said = "" if column.values is None or column.constant else _jumps(column.values, starts, column.unit)
        done.append(column._replace(remarks=(*column.remarks, said)) if said else column)
    return done


def _column(table: Table, name: str, unit: str) -> Column:
    try:
        values = table.numbers(name)
    except DataError as error:
        return _texts(table, name, unit, str(error))
    finite = np.isfinite(values)
    if not finite.any():
        return Column(name, unit, None, ("empty",), ())
    remarks = [f"{int((~finite).sum())} entries missing"] if not finite.all() else []
    if np.ptp(values[finite]) == 0:
        return Column(name, unit, values, (f"constant, {values[finite][0]:.6g}", *remarks), ())
    return Column(name, unit, values, tuple(remarks), ())


def _texts(table: Table, name: str, unit: str, fault: str) -> Column:
    try:
        labels = table.labels(name)
    except DataError:
        return Column(name, unit, None, ("no numbers and no texts",), ())
    distinct = list(dict.fromkeys(labels[labels != ""].tolist()))
    numbers = sum(is_number(text) for text in distinct)
    if distinct and numbers > PATIENCE * len(distinct):
        return Column(name, unit, None, ("numbers and texts",), (f"{name} is not read as numbers: {fault}",))
    shown = ", ".join(repr(text) for text in distinct[:3]) + (", ..." if len(distinct) > 3 else "")
    return Column(name, unit, None, (f"text: {shown}" if distinct else "empty",), ())


def _jumps(values: np.ndarray, starts: np.ndarray, unit: str) -> str:
    """Say that a column jumps, or wraps as an angle does; empty: it does not, or has a few levels only."""
    steps = np.abs(np.delete(np.diff(values), starts[starts > 0] - 1))
    steps = steps[np.isfinite(steps)]
    if len(steps) < 10 or len(np.unique(values[np.isfinite(values)])) <= LEVELS:
        return ""
    for turn, name in TURNS.items():
        wraps = int(np.sum(steps > WRAP * turn))
        if (
            wraps
            and unit in ("", "rad", "deg", "°")
            and abs(float(np.nanmax(values) - np.nanmin(values)) / turn - 1) < NEARLY
        ):
            return f"wraps {wraps} times by a turn: an angle in {name}"
    large = steps > JUMP * max(float(np.percentile(steps, 95)), 1e-12 * float(steps.max()))
    if not large.any() or large.mean() > FEW:
        return ""
    return f"{int(large.sum())} jumps, the largest by {steps.max():.3g}"
