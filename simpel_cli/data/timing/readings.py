"""What a sensor said and when, on the clock of the rows: by the rows' own time, by a clock column, or in a joined table."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from simpel_cli.data.rows import Rows
from simpel_cli.data.tables.table import Table
from simpel_cli.data.timing.joined_tables import Joined
from simpel_cli.errors import DataError

NS = 1e-9  # s


class Readings(NamedTuple):
    """Values of one sensor, within an episode in the order of their times.

    Args:
        episode: (m,) of the rows that they belong to.
        time: (m,) s, when they were recorded, on the clock of the rows.
        value: (m,) in the quantity's unit, finite.
        repeated: number of entries that repeat what the sensor said before.
        source: where they stand, for messages.
        every: whether an episode that none of them belongs to is an error.
    """

    episode: np.ndarray
    time: np.ndarray
    value: np.ndarray
    repeated: int
    source: str
    every: bool


def at_rows(rows: Rows, values: np.ndarray, name: str) -> Readings:
    """Return values that were recorded at the times of their rows.

    Args:
        rows: of the main table.
        values: (n,) of the quantity.
        name: its column, for messages.
    """
    said = np.isfinite(values) & np.isfinite(rows.time) & (rows.episode != "")
    return Readings(rows.episode[said], rows.time[said], values[said], 0, f"'{name}'", every=True)


def by_clock(rows: Rows, values: np.ndarray, table: Table, time: str, clock: str, name: str, key: str) -> Readings:
    """Return values that were recorded at the times of a clock column.

    Args:
        rows: of the main table.
        values: (n,) of the quantity.
        table: the main table.
        time: column of the rows' time.
        clock: column of the sensor's time.
        name: column of the quantity, for messages.
        key: that names the clock, for messages.

    Raises:
        DataError: there is no such column, its clock runs backwards, or only one of both clocks has a date.
    """
    if clock not in table.columns:
        raise table.missing(clock, f"{key} names it.")
    stamps = table.numbers(clock)[rows.number] + _between_zeros(table, time, clock)[rows.number]
    said = np.flatnonzero(np.isfinite(stamps) & np.isfinite(values) & (rows.episode != ""))
    episode, stamps, values = rows.episode[said], stamps[said], values[said]
    same = episode[1:] == episode[:-1]
    _refuse_backwards(
        stamps, same, rows.number[said], table, clock, f"Sort the file, or name the right column in {key}."
    )
    new = np.append(True, ~same | (stamps[1:] != stamps[:-1]) | (values[1:] != values[:-1]))[: len(said)]
    source = f"'{name}' by its clock '{clock}'"
    return Readings(episode[new], stamps[new], values[new], len(new) - int(new.sum()), source, every=True)


def of_joined(
    joined: Joined, column: str, rows: Rows, table: Table, time: str, labels: np.ndarray | None, earlier: float
) -> Readings:
    """Return the values of a column of a joined table.

    Args:
        joined: the table.
        column: of it.
        rows: of the main table.
        table: the main table.
        time: column of the rows' time.
        labels: (n,) name that the main table gives the episode of each row; None: it gives none.
        earlier: s, how long before its time a value was measured, which says in which episode that was.

    Raises:
        DataError: its clock runs backwards, only one of both clocks has a date, or its episodes are not those of the rows.
    """
    other = joined.table
    values, stamps = other.numbers(column), other.numbers(joined.time)
    zero, zeros = _zeros(other, joined.time), _zeros(table, time)
    if (zero is None) != (zeros is None):
        dated, plain = (joined.time, time) if zeros is None else (time, joined.time)
        raise DataError(
            f"{joined.key}.time: '{dated}' holds dates and times, '{plain}' numbers, so that they have no common zero. "
            "Write both in the same way."
        )
    # ns from the first zero of all: the difference is taken in whole numbers
    first = min([*(zero or []), *(zeros or [])], default=0)
    if zero is not None:
        stamps = stamps + NS * (np.array(zero) - first)[other.file]
    offset = np.zeros(len(rows.number)) if zeros is None else NS * (np.array(zeros) - first)[table.file[rows.number]]
    names = other.labels(joined.episode) if joined.episode is not None else np.full(len(other), "")
    said = np.flatnonzero(np.isfinite(stamps) & ((names != "") if joined.episode is not None else True))
    same = (names[said][1:] == names[said][:-1]) & (other.file[said][1:] == other.file[said][:-1])
    cure = (
        "Sort the file."
        if joined.episode
        else f"Sort the file; if it holds several episodes, name their column: {joined.key}.episode."
    )
    _refuse_backwards(stamps[said], same, said, other, joined.time, cure)
    said = said[np.isfinite(values[said])]
    if joined.episode is not None and labels is not None:
        episode = _by_name(joined, names[said], rows, labels)
    else:
        episode = _by_time(joined, stamps[said] - earlier, rows, rows.time + offset)
    start = {name: offset[i] for name, i in zip(*np.unique(rows.episode, return_index=True), strict=True)}
    stamps = stamps[said] - np.array([start.get(name, 0.0) for name in episode.tolist()])
    order = np.lexsort((stamps, episode))
    episode, stamps, values = episode[order], stamps[order], values[said][order]
    by_name = joined.episode is not None
    return Readings(episode, stamps, values, 0, f"'{column}' of {other.name}", every=by_name)


def _by_name(joined: Joined, names: np.ndarray, rows: Rows, labels: np.ndarray) -> np.ndarray:
    """Return the episode of every value, empty where the rows have none of its name."""
    pairs = dict.fromkeys(zip(labels.tolist(), rows.episode.tolist(), strict=True))
    known = {label: episode for label, episode in pairs if label}
    if len(known) < len([label for label, _ in pairs if label]):
        twice = next(label for label, episode in pairs if label and known[label] != episode)
        raise DataError(
            f"{joined.key}.episode: '{twice}' is an episode in more than one file of data.path, so that it is not known to "
            "which "
            f"one that of {joined.table.name} belongs. Give every episode a name of its own, e.g. by the names of files: "
            "path: 'runs/{run}/fast.csv' and 'runs/{run}/slow.csv', with data.episode: run."
        )
    there = set(names.tolist())
    alone = [label for label in known if label not in there]
    if alone:
        shown = ", ".join(sorted(there)[:5]) + (", ..." if len(there) > 5 else "")
        raise DataError(
            f"{joined.key}: {joined.table.name} has no value in episode {alone[0]} of data.path (it has: "
            f"{shown or 'none'}). Name the "
            f"column of the same names in {joined.key}.episode, or leave the episode out of data.path."
        )
    return np.array([known.get(name, "") for name in names.tolist()], dtype=rows.episode.dtype)


def _by_time(joined: Joined, stamps: np.ndarray, rows: Rows, time: np.ndarray) -> np.ndarray:
    """Return the episode in which, or before which, every value was recorded."""
    known = np.isfinite(time) & (rows.episode != "")
    found = [(name, time[known & (rows.episode == name)]) for name in dict.fromkeys(rows.episode[known].tolist())]
    spans = sorted((float(own.min()), float(own.max()), name) for name, own in found)
    for (begin, end, name), (later, last, other) in pairwise(spans):
        if later <= end:
            raise DataError(
                f"{joined.key}: episodes {name} ({begin:.6g} to {end:.6g} s) and {other} ({later:.6g} to {last:.6g} s) of "
                "data.path "
                f"overlap in time, so that it is not known to which of them values of {joined.table.name} belong. Name the "
                f"column of the same names in both: data.episode and {joined.key}.episode."
            )
    ends = np.array([end for _, end, _ in spans])
    which = np.minimum(np.searchsorted(ends, stamps), max(len(spans) - 1, 0))
    return np.array([name for *_, name in spans], dtype=rows.episode.dtype)[which]


def _refuse_backwards(
    stamps: np.ndarray, same: np.ndarray, number: np.ndarray, table: Table, clock: str, cure: str
) -> None:
    """Refuse times that fall, where one entry follows another of the same episode.

    Args:
        stamps: (m,) s.
        same: (m - 1,) whether the next entry is of the same episode.
        number: (m,) row in the table.
        table: has them.
        clock: its column.
        cure: what to do.
    """
    back = np.flatnonzero(same & (np.diff(stamps) < 0))
    if len(back):
        i = int(back[0])
        raise DataError(
            f"clock '{clock}' runs backwards at {table.place(int(number[i + 1]))}: {stamps[i]:.6g} s, then "
            f"{stamps[i + 1]:.6g} s. {cure}"
        )


def _zeros(table: Table, column: str) -> list[int] | None:
    zeros = [zero for zero in table.zeros(column) if zero is not None]
    return zeros if len(zeros) == len(table.sheets) else None


def _between_zeros(table: Table, time: str, clock: str) -> np.ndarray:
    """Return what to add to a clock column for the zero of the time column, s, by row of the table."""
    shifts = []
    for sheet, a, b in zip(table.sheets, table.zeros(time), table.zeros(clock), strict=True):
        if (a is None) != (b is None):
            dated, plain = (time, clock) if b is None else (clock, time)
            raise DataError(
                f"'{dated}' of {sheet.path.name} holds dates and times, '{plain}' numbers, so that they have no common zero. "
                "Write both in the same way."
            )
        shifts.append(0.0 if a is None or b is None else NS * (b - a))
    return np.array(shifts)[table.file]
