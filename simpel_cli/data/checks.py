"""What can be wrong with rows: each check reports, and drops, cuts or refuses where it must."""

import math

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check, Source
from simpel_cli.data.rows import Rows
from simpel_cli.data.sensor_checks import IRREGULAR_SHARE, irregular_share
from simpel_cli.data.smoother import speeds
from simpel_cli.data.table import Table
from simpel_cli.data.units import period
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Quantity

DT_TOLERANCE = 0.02  # relative; more is another sampling time, not jitter
MAX_UPSAMPLING = 10.0  # more new rows than that between two measured ones are invented
MOSTLY = 0.5  # of the values outside a range: it is the unit, not the motion
SPIKE = 10.0  # widths of a range beyond it
DEGREES = 361.0  # no angle in degrees within one turn reads more
MANY_GAPS = 0.01  # of the steps; more are a clock that is irregular
LARGEST = 1e100  # beyond, squares overflow; no sensor gives it


def finite(rows: Rows, measured: np.ndarray, names: tuple[str, ...]) -> tuple[Check, Rows]:
    """Drop rows with NaN or inf. The jump that stays in `position` cuts the episode there.

    The last row of an episode often has no command: it stays, with the input held, since no transition starts there.

    Args:
        rows: of the file.
        measured: mask (n_states,); the columns of the others are NaN throughout and do not count.
        names: of time, measured states, inputs, outputs and next states, in that order.

    Raises:
        DataError: no row is left.
    """
    last = np.append(rows.episode[1:] != rows.episode[:-1], True) & (rows.position > 0)
    inputs, note = rows.inputs.copy(), ""
    if measured.size and rows.next_states.shape[1] == 0:
        ends = np.flatnonzero(last & ~np.isfinite(inputs).all(axis=1))
        inputs[ends] = inputs[ends - 1]
        note = f"; {len(ends)} episodes end without a command" if len(ends) else ""
    rows = rows._replace(inputs=inputs)
    values = np.column_stack([rows.time, rows.states[:, measured], inputs, rows.outputs, rows.next_states])
    good = np.isfinite(values) & (np.abs(values) < LARGEST)
    keep = good.all(axis=1) & (rows.episode != "")
    dropped = len(keep) - int(keep.sum())
    if dropped == len(keep):
        empty = [name for name, column in zip(names, good.T, strict=True) if not column.any()]
        which = (
            f"'{empty[0]}' has no number at all" if empty else "every one has NaN, inf or nothing in one of its columns"
        )
        raise DataError(
            f"no row is complete: {which}. If it was not measured, say `columns: {{<state>: null}}`; "
            "an input must be measured."
        )
    if dropped == 0:
        return Check("finite", True, f"all {len(keep)} rows{note}"), rows
    where = ", ".join(name for name, column in zip(names, good.T, strict=True) if not column.all()) or "the episode"
    detail = f"{dropped} of {len(keep)} rows dropped (NaN, inf or nothing in {where}); episodes are cut there{note}"
    return Check("finite", False, detail), rows.take(keep)


def monotonic(rows: Rows, table: Table, config: Measurements) -> Check:
    """Refuse time that stands still or runs backwards within an episode.

    Raises:
        DataError: names row, episode and the two times.
    """
    back = (np.diff(rows.time) <= 0) & _same_episode(rows)
    if back.any():
        i = int(np.flatnonzero(back)[0])
        fault = "stands still" if rows.time[i + 1] == rows.time[i] else "runs backwards"
        cure = "Sort the file or remove repeated rows."
        if config.episode is None:
            cure += " If the file holds several episodes, name their column: data.episode."
        raise DataError(
            f"time {fault} at {table.place(int(rows.number[i + 1]))}, episode {rows.episode[i]}: "
            f"{rows.time[i]:.6g} s, then {rows.time[i + 1]:.6g} s. {cure}"
        )
    return Check("time", True, "increasing")


def sampling(rows: Rows, model: Source, config: Measurements) -> tuple[Check, float]:
    """Compare the distance of the rows with the simulator's dt.

    Returns:
        The check, and the dt of the data, s (median).

    Raises:
        ConfigError: data.resample is not the simulator's dt.
        DataError: too few rows, or a dt that is not the simulator's.
    """
    if config.resample is not None and not math.isclose(config.resample, model.dt, rel_tol=1e-3):
        raise ConfigError(
            f"data.resample: {config.resample:g} s is not the dt of simulator '{model.name}'. "
            f"Set data.resample: {model.dt:g}, or sim.dt: {config.resample:g}."
        )
    steps = np.diff(rows.time)[_follows(rows)]
    if len(steps) == 0 and not model.states and config.resample is None:
        return Check("sampling", True, "every row is an episode of its own"), model.dt
    if len(steps) == 0:
        raise DataError(f"too few rows: none of {len(rows.time)} rows follows another in the same episode.")
    dt = float(np.median(steps))
    in_ms = " The time looks like ms: it is read in s." if math.isclose(dt, 1e3 * model.dt, rel_tol=0.02) else ""
    if config.resample is not None and dt > MAX_UPSAMPLING * model.dt:
        raise DataError(
            f"the rows are {dt:.4g} s apart: resampling to {model.dt:g} s would invent most rows.{in_ms} "
            f"Record faster, or set sim.dt: {dt:.4g} and data.resample: null."
        )
    if config.resample is None and model.states and abs(dt / model.dt - 1) > DT_TOLERANCE:
        bridge, why = "", ""
        if irregular_share(steps, dt) > IRREGULAR_SHARE:
            bridge = _bridge(steps, 1.5 * max(dt, model.dt), " and ")
            why = " (in the middle; they are irregular)"
        raise DataError(
            f"the rows are {dt:.4g} s apart{why}, but simulator '{model.name}' steps {model.dt:g} s.{in_ms} "
            f"Bring the data to it with data.resample: {model.dt:g}{bridge}, or set sim.dt: {dt:.4g}."
        )
    return Check("sampling", True, f"dt {dt:.4g} s"), dt


def gaps(rows: Rows, dt: float, config: Measurements) -> tuple[Check, np.ndarray]:
    """Find where a segment of contiguous rows starts.

    Args:
        rows: checked for NaN.
        dt: of the data, s.
        config: `max_gap`, s; null = 1.5 steps, of the data or of what they are resampled to.

    Returns:
        The check, and a mask (n,): True at the first row of every segment (new episode, new split, dropped row, gap).
    """
    limit = 1.5 * max(dt, config.resample or 0.0) if config.max_gap is None else config.max_gap
    steps = np.diff(rows.time)
    gap = _follows(rows) & (steps > limit)
    starts = np.concatenate([[True], ~_follows(rows) | gap | (rows.split[1:] != rows.split[:-1])])
    if not gap.any():
        return Check("gaps", True, f"no step longer than {limit:.3g} s"), starts
    shown = [f"episode {rows.episode[i]} at {rows.time[i]:.4g} s ({steps[i]:.3g} s)" for i in np.flatnonzero(gap)[:3]]
    more = ", ..." if gap.sum() > len(shown) else ""
    detail = f"{int(gap.sum())} gaps longer than {limit:.3g} s, cut there: {', '.join(shown)}{more}"
    if config.resample is not None and gap.sum() > MANY_GAPS * np.sum(_follows(rows)):
        detail += f". Wider ones are bridged with {_bridge(steps[_follows(rows)], limit, '')}"
    return Check("gaps", False, detail), starts


def _bridge(steps: np.ndarray, limit: float, before: str) -> str:
    """Say which data.max_gap passes over 99 % of the steps; nothing if they are no longer than the limit anyway."""
    longest = float(np.percentile(steps, 99))
    if longest <= limit:
        return ""
    digit = 10.0 ** (math.floor(math.log10(longest)) - 1)
    return f"{before}data.max_gap: {math.ceil(longest / digit) * digit:.4g}"


def constant(rows: Rows, model: Source, outputs: tuple[str, ...]) -> Check:
    """Warn of columns that never change.

    Raises:
        DataError: no measured state or output changes, so there is nothing to learn.
    """
    columns = {name: values for name, values in _named(rows, model, outputs).items() if len(values) > 1}
    still = [name for name, values in columns.items() if np.ptp(values) == 0]
    moving = [name for name in columns if name not in still and name not in {q.name for q in model.inputs}]
    if columns and not moving:
        raise DataError(f"nothing moves: {', '.join(still)} are constant over all {len(rows.time)} rows.")
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
            found.append(f"{name} reaches {np.max(np.abs(values)):.4g}, most of it outside {box}{in_degrees}")
        elif outside:
            cure = ""
            if outside > MOSTLY * len(values):
                cure = in_degrees if quantity.unit.startswith("rad") else ": compare the unit of the column"
            elif (far := _farthest(values, quantity)) is not None:
                cure = f", as far as {far:.4g}: a spike? It spoils every fit; take it out"
            found.append(f"{name} {outside} of {len(values)} outside {box}{cure}")
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
    if np.mean((values < angle.low) | (values > angle.high)) <= MOSTLY or not _follows(rows).any():
        return False
    turned = np.abs(np.diff(values))[_follows(rows)]
    ranges = {q.name: max(abs(q.low), abs(q.high)) for q in model.states}
    limits = [ranges[speed] for speed, angles in speeds(model).items() if angle.name in angles]
    if limits:
        return bool(np.median(turned / np.diff(rows.time)[_follows(rows)]) > min(limits))
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


def _same_episode(rows: Rows) -> np.ndarray:
    return rows.episode[1:] == rows.episode[:-1]


def _follows(rows: Rows) -> np.ndarray:
    """Mask (n-1,): row i+1 is the next row of the same episode, none was dropped between."""
    return _same_episode(rows) & (np.diff(rows.position) == 1)
