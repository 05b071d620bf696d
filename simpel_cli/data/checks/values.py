"""Values of measured columns: finite, varying, within the declared ranges."""

import math

import numpy as np

from simpel_cli.data.checks.units import period
from simpel_cli.data.estimation.smoother import speeds
from simpel_cli.data.recording import Check, Source
from simpel_cli.data.rows import Rows, follows
from simpel_cli.errors import DataError
from simulators.model import Quantity

MOSTLY = 0.5  # share of the values outside a range, above which the unit is probably wrong
SPIKE = 10.0  # widths of a range beyond it
DEGREES = 361.0  # largest angle in degrees within one turn
LARGEST = 1e100  # beyond, squares overflow; no sensor gives it


def finite(rows: Rows, measured: np.ndarray, names: tuple[str, ...], *, partial: bool = False) -> tuple[Check, Rows]:
    """Drop rows with NaN or inf. The jump that stays in `position` cuts the episode there.

    The last row of an episode often has no command: it stays, with the input held, since no transition starts there.

    Args:
        rows: of the file.
        measured: mask (n_states,); the columns of the others are NaN throughout and do not count.
        names: of time, measured states, inputs, outputs and next states, in that order.
        partial: keep a row in which a state or an output is missing; it is NaN there, and costs that value only.

    Raises:
        DataError: no row is left.
    """
    rows, ends = _with_last_inputs(rows)
    note = f"; {ends} episodes end without a command" if ends else ""
    values = np.column_stack([rows.time, rows.states[:, measured], rows.inputs, rows.outputs, rows.next_states])
    good = np.isfinite(values) & (np.abs(values) < LARGEST)
    if partial:
        return _partial(rows, measured, good, names)
    keep = good.all(axis=1) & (rows.episode != "")
    dropped = len(keep) - int(keep.sum())
    if dropped == len(keep):
        empty = [name for name, column in zip(names, good.T, strict=True) if not column.any()]
        which = f"'{empty[0]}' has no numbers" if empty else "every row has NaN, inf or an empty cell"
        raise DataError(
            f"no row is complete: {which}. If it was not measured, set `columns: {{<state>: null}}`; "
            "an input must be measured."
        )
    if dropped == 0:
        return Check("finite", True, f"all {len(keep)} rows are finite{note}"), rows
    where = ", ".join(name for name, column in zip(names, good.T, strict=True) if not column.all()) or "the episode"
    detail = f"{dropped} of {len(keep)} rows dropped (NaN, inf or empty in {where}); episodes are cut there{note}"
    return Check("finite", False, detail), rows.take(keep)


def usable(rows: Rows) -> np.ndarray:
    """Mask (n,) of the rows whose time, inputs and episode are known."""
    rows, _ = _with_last_inputs(rows)
    known = np.column_stack([rows.time, rows.inputs])
    return np.asarray((np.isfinite(known) & (np.abs(known) < LARGEST)).all(axis=1) & (rows.episode != ""))


def _with_last_inputs(rows: Rows) -> tuple[Rows, int]:
    """Hold the input in the last row of an episode that has none: no transition starts there. Return how many there are."""
    if not rows.states.shape[1] or rows.next_states.shape[1]:
        return rows, 0
    last = np.append(rows.episode[1:] != rows.episode[:-1], True) & (rows.position > 0)
    inputs = rows.inputs.copy()
    ends = np.flatnonzero(last & ~np.isfinite(inputs).all(axis=1))
    inputs[ends] = inputs[ends - 1]
    return rows._replace(inputs=inputs), len(ends)


def _partial(rows: Rows, measured: np.ndarray, good: np.ndarray, names: tuple[str, ...]) -> tuple[Check, Rows]:
    """Keep every row whose time and inputs are known; a value that is none becomes NaN.

    Args:
        rows: of the file.
        measured: mask (n_states,).
        good: which values count, (n, columns), in the order of `names`.
        names: of time, measured states, inputs and outputs.

    Raises:
        DataError: no row is left, or a column has no value.
    """
    first, last = 1 + int(measured.sum()), len(names) - rows.outputs.shape[1]
    known = good[:, [0, *range(first, last)]].all(axis=1) & (rows.episode != "")
    sensors = [*range(1, first), *range(last, len(names))]
    for k in sensors:
        if not good[known, k].any():
            raise DataError(
                f"no row can be used: '{names[k]}' has no numbers where time and inputs are known. If it was not measured, set "
                "`columns: {<state>: null}`."
            )
    states, outputs = rows.states.copy(), rows.outputs.copy()
    states[:, measured] = np.where(good[:, 1:first], states[:, measured], np.nan)
    outputs = np.where(good[:, last:], outputs, np.nan)
    missing = {names[k]: int((~good[known, k]).sum()) for k in sensors}
    notes = [f"{count} of {name}" for name, count in missing.items() if count]
    dropped = len(known) - int(known.sum())
    kept = rows._replace(states=states, outputs=outputs).take(known)
    if not notes and not dropped:
        return Check("finite", True, f"all {len(known)} rows are finite"), kept
    cells = f"missing values, each of which costs itself only: {', '.join(notes)}" if notes else ""
    gone = f"{dropped} of {len(known)} rows dropped, whose time or inputs are not known" if dropped else ""
    return Check("finite", not dropped, "; ".join(filter(None, [gone, cells]))), kept


def filled(rows: Rows) -> Rows:
    """Return rows in which what is missing repeats the value before it (the first one, the next): for checks of values."""

    def column(values: np.ndarray) -> np.ndarray:
        there = np.flatnonzero(np.isfinite(values))
        if len(there) == 0 or len(there) == len(values):
            return values
        before = np.maximum(np.searchsorted(there, np.arange(len(values)), side="right") - 1, 0)
        return values[there[before]]

    states, outputs = (np.apply_along_axis(column, 0, a) if a.size else a for a in (rows.states, rows.outputs))
    return rows._replace(states=states, outputs=outputs)


def complete(rows: Rows, measured: np.ndarray) -> np.ndarray:
    """Mask (n,) of the rows in which nothing is missing."""
    return np.isfinite(rows.states[:, measured]).all(axis=1) & np.isfinite(rows.outputs).all(axis=1)


def constant(rows: Rows, model: Source, outputs: tuple[str, ...]) -> Check:
    """Warn of columns that never change.

    Raises:
        DataError: no measured state or output changes, so there is nothing to learn.
    """
    columns = {name: values for name, values in _named(rows, model, outputs).items() if len(values) > 1}
    still = [name for name, values in columns.items() if np.ptp(values) == 0]
    moving = [name for name in columns if name not in still and name not in {q.name for q in model.inputs}]
    if columns and not moving:
        raise DataError(f"nothing changes: {', '.join(still)} are constant over all {len(rows.time)} rows.")
    return Check("constant", not still, f"constant: {', '.join(still)}" if still else "every column changes")


def ranges(rows: Rows, model: Source, outputs: tuple[str, ...]) -> Check:
    """Count values outside the simulator's declared ranges; angles are compared modulo a turn.

    Where most of an angle or a turn rate is outside, it may be in degrees. An angle in degrees is inside modulo a turn,
    so it is also suspected if it is outside as it stands and would turn faster than its speed is declared to be.
    """
    quantities = {q.name: q for q in (*model.states, *model.inputs, *model.outputs)}
    found = []
    for name, values in _named(rows, model, outputs).items():
        quantity = quantities[name]
        outside = int(np.sum(_outside(values, quantity)))
        box = f"[{quantity.low:g}, {quantity.high:g}] {quantity.unit}".rstrip()
        in_degrees = f": is it in degrees? Then multiply the column by pi/180 ({math.pi / 180:.4f})"
        if quantity.unit.startswith("rad") and quantity.periodic and _too_fast(rows, values, quantity, model):
            found.append(f"{name} reaches {np.max(np.abs(values)):.4g}, most values outside {box}{in_degrees}")
        elif outside:
            cure = ""
            if outside > MOSTLY * len(values):
                cure = in_degrees if quantity.unit.startswith("rad") else ": check the unit of the column"
            elif (far := _farthest(values, quantity)) is not None:
                cure = f", the farthest is {far:.4g}: remove it if it is an outlier, it would distort every fit"
            found.append(f"{name}: {outside} of {len(values)} values outside {box}{cure}")
    return Check("ranges", not found, "; ".join(found) if found else "all values inside the declared ranges")


def _farthest(values: np.ndarray, quantity: Quantity) -> float | None:
    """Return the value farthest outside the range, where that is farther than any motion goes; else None."""
    if quantity.periodic:
        return None
    beyond = np.maximum(quantity.low - values, values - quantity.high) / (quantity.high - quantity.low)
    row = int(np.argmax(np.nan_to_num(beyond, nan=-np.inf)))
    return float(values[row]) if beyond[row] > SPIKE else None


def _too_fast(rows: Rows, values: np.ndarray, angle: Quantity, model: Source) -> bool:
    """Whether an angle lies mostly outside its range, and turns faster than its speed's range, or than can be seen."""
    if np.mean((values < angle.low) | (values > angle.high)) <= MOSTLY or not follows(rows).any():
        return False
    turned = np.abs(np.diff(values))[follows(rows)]
    ranges = {q.name: max(abs(q.low), abs(q.high)) for q in model.states}
    limits = [ranges[speed] for speed, angles in speeds(model).items() if angle.name in angles]
    if limits:
        return bool(np.median(turned / np.diff(rows.time)[follows(rows)]) > min(limits))
    return bool(np.max(np.abs(values)) <= DEGREES and np.ptp(values) > 4 * math.pi)


def _outside(values: np.ndarray, quantity: Quantity) -> np.ndarray:
    turn = period(quantity)
    if turn is not None:
        # the turn that starts half a turn below the middle of the range, so that the range is not torn
        start = (quantity.low + quantity.high - turn) / 2
        values = (values - start) % turn + start
    slack = 1e-6 * (quantity.high - quantity.low)
    return (values < quantity.low - slack) | (values > quantity.high + slack)


def _named(rows: Rows, model: Source, outputs: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Measured columns by name: states, inputs, outputs."""
    states = {q.name: column for q, column in zip(model.states, rows.states.T, strict=True)}
    measured = {name: column for name, column in states.items() if not np.isnan(column).all()}
    inputs = {q.name: column for q, column in zip(model.inputs, rows.inputs.T, strict=True)}
    return measured | inputs | dict(zip(outputs, rows.outputs.T, strict=True))
