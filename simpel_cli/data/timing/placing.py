"""To which row a value belongs: the first one at or after the instant at which it was measured.

    m = t - latency,     k = first row with time[k] >= m,     late = time[k] - m

The later one of two values that fall into one row stays. What was measured more than a row before the first one of an
episode, after its last one, or within a gap of the rows has no row.
"""

from typing import NamedTuple

import numpy as np

from simpel_cli.data.rows import Rows, follows, same_episode
from simpel_cli.data.timing.readings import Readings
from simpel_cli.errors import DataError

TIE = 1e-3  # of a row: an instant so little after a row is that of the row
WHOLE = 0.01  # of a row: a latency so near to a whole number of rows shifts a column by that
GAP = 1.5  # rows: a longer step is a gap, where max_gap says nothing


class Placed(NamedTuple):
    """Values of one quantity in the rows, and what has no row.

    Args:
        values: (n,) NaN where there is none.
        late: (n,) s, how long before its row each was measured; 0 where there is none.
        outside: number of values that were measured before, after or between the rows.
        replaced: number of values that a later one of the same row replaced.
    """

    values: np.ndarray
    late: np.ndarray
    outside: int
    replaced: int


def step_of(rows: Rows, dt: float) -> float:
    """Return the usual distance of rows, s; the simulator's where no row follows another."""
    steps = np.diff(rows.time)[follows(rows)]
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else dt


def refuse_longer(rows: Rows, latency: float, key: str, step: float) -> None:
    """Refuse a latency that is longer than an episode.

    Args:
        rows: those whose time is known.
        latency: s.
        key: that says it, for messages.
        step: usual distance of rows, s; a tie.
    """
    starts, ends = _bounds(rows)
    for begin, end in zip(starts, ends, strict=True):
        length = rows.time[end - 1] - rows.time[begin]
        if latency > length + TIE * step:
            raise DataError(
                f"{key}: {latency:g} s is longer than episode {rows.episode[begin]}, which lasts {length:.6g} s, so that "
                "nothing measured in it is recorded in it. Check the unit (s), or leave the episode out."
            )


def shifted(rows: Rows, values: np.ndarray, count: int, latency: float, step: float) -> Placed:
    """Move a column up by whole rows within every episode.

    Args:
        rows: all of the main table, also those that are dropped later.
        values: (n,) of the quantity.
        count: rows.
        latency: s, about `count` rows: rows that are another distance apart, because of a gap, are no partners.
        step: usual distance of rows, s.
    """
    n = len(values)
    to = np.arange(n) - count
    there = (to >= 0) & np.isfinite(values)
    to = np.maximum(to, 0)
    mine = there & (rows.episode == rows.episode[to]) & (rows.position - rows.position[to] == count)
    mine &= ~(np.abs(rows.time - latency - rows.time[to]) > 0.5 * step)
    moved = np.full(n, np.nan)
    moved[to[mine]] = values[mine]
    return Placed(moved, np.zeros(n), int(np.isfinite(values).sum() - mine.sum()), 0)


def placed(readings: Readings, rows: Rows, latency: float, step: float, max_gap: float | None) -> Placed:
    """Give every value its row.

    Args:
        readings: of one quantity.
        rows: those that are kept, in the order of time within every episode.
        latency: how old a value is when it is recorded, s.
        step: usual distance of rows, s.
        max_gap: a longer step is a gap, s; None: the usual rule.

    Raises:
        DataError: values and rows have no time in common.
    """
    n = len(rows.time)
    values, late = np.full(n, np.nan), np.zeros(n)
    most = _longest(rows, step, max_gap) + TIE * step
    outside = replaced = 0
    starts, ends = _bounds(rows)
    used = 0
    for begin, end in zip(starts, ends, strict=True):
        own = readings.episode == rows.episode[begin]
        if not own.any():
            continue
        times, measured = rows.time[begin:end], readings.time[own] - latency
        row = np.searchsorted(times, measured - TIE * step)
        inside = row < len(times)
        before = np.where(inside, times[np.minimum(row, len(times) - 1)] - measured, 0.0)
        inside &= before <= most[begin:end][np.minimum(row, len(times) - 1)]
        if readings.every and not inside.any():
            raise DataError(_apart(readings, measured, times, f" in episode {rows.episode[begin]}"))
        row, before, said = row[inside], before[inside], readings.value[own][inside]
        last = np.append(row[1:] != row[:-1], True) if len(row) else np.zeros(0, bool)
        values[begin + row[last]], late[begin + row[last]] = said[last], np.maximum(before[last], 0.0)
        outside += int((~inside).sum())
        replaced += int((~last).sum())
        used += int(last.sum())
    alone = int((~np.isin(readings.episode, rows.episode)).sum())
    if used == 0 and len(readings.time):
        raise DataError(_apart(readings, readings.time - latency, rows.time, ""))
    return Placed(values, late, outside + alone, replaced)


def _longest(rows: Rows, step: float, max_gap: float | None) -> np.ndarray:
    """How long before its row a value may have been measured, (n,) s: since the row before, or a usual step."""
    steps = np.append(np.inf, np.where(same_episode(rows), np.diff(rows.time), np.inf))
    limit = GAP * max(step, float(np.percentile(steps[np.isfinite(steps)], 99)) if np.isfinite(steps).any() else step)
    return np.where(steps <= (limit if max_gap is None else max_gap), steps, step)


def _bounds(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """First row of every episode, and the one behind its last."""
    starts = np.flatnonzero(np.append(True, ~same_episode(rows))) if len(rows.time) else np.zeros(0, int)
    return starts, np.append(starts[1:], len(rows.time))[: len(starts)]


def _apart(readings: Readings, measured: np.ndarray, times: np.ndarray, where: str) -> str:
    return (
        f"{readings.source} and the rows of data.path have no time in common{where}: its values were measured from "
        f"{measured.min():.6g} to {measured.max():.6g} s, the rows are from {times.min():.6g} to {times.max():.6g} s. Both "
        "clocks need "
        "the same zero: a clock that is ahead has a latency (data.latency), other zeros can be added in data.computed."
    )
