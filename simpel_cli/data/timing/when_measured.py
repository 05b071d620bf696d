"""Rows in which every value stands where it was measured, and how long before its row: latencies, clocks, joined tables."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.checks import clock, values
from simpel_cli.data.checks.sensors import irregular_share
from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check, Source
from simpel_cli.data.rows import Mapping, Rows, follows
from simpel_cli.data.tables.table import Table
from simpel_cli.data.timing.joined_tables import Joined
from simpel_cli.data.timing.placing import TIE, WHOLE, Placed, placed, refuse_longer, shifted, step_of
from simpel_cli.data.timing.readings import Readings, at_rows, by_clock, of_joined
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Model

EXACT = 0.02  # of a row: where a row is needed whole, a value so little before it counts as one of it


class _Sensor(NamedTuple):
    """When a measured quantity is measured.

    Args:
        name: of the quantity.
        latency: s.
        key: that says so, for messages.
        clock: column of its own time; None: it has none.
        joined: which of the joined tables has it; None: the main one.
    """

    name: str
    latency: float
    key: str
    clock: str | None
    joined: int | None

    @property
    def own_times(self) -> bool:
        return self.clock is not None or self.joined is not None

    @property
    def said_by(self) -> str:
        return (
            f"data.times.{self.name}"
            if self.clock is not None
            else f"data.join[{self.joined}]"
            if self.own_times
            else self.key
        )


def refuse_unplaced(config: Measurements, model: Source, mapping: Mapping) -> None:
    """Refuse times of measurement where rows do not follow each other, or are brought to another dt.

    Raises:
        ConfigError: with the cure.
    """
    for name, ends in config.latency_ranges().items():
        if config.layout == "transitions" or config.resample is not None:
            raise ConfigError(f"data.latency.{name}: [{ends[0]:g}, {ends[1]:g}] s, but {_why(config)}")
    for sensor in _sensors(config, model, mapping):
        if config.layout == "transitions":
            off = f" Or say that it is not late: data.latency={{{sensor.name}: 0}}." if not sensor.own_times else ""
            raise ConfigError(f"{sensor.said_by}: {_why(config)}{off}")
        if config.resample is not None and sensor.own_times:
            raise ConfigError(f"{sensor.said_by}: {_why(config)}")


def when_measured(
    config: Measurements,
    model: Source,
    rows: Rows,
    table: Table,
    mapping: Mapping,
    joined: Sequence[Joined],
    labels: np.ndarray | None,
    *,
    partial: bool,
    ranges: bool,
) -> tuple[Rows, Check | None]:
    """Bring every value to the row that follows the instant at which it was measured.

    Args:
        config: the data YAML.
        model: the simulator, which may say how late its outputs are recorded.
        rows: all of the main table.
        table: the main table.
        mapping: which column is which quantity.
        joined: tables of other sensors.
        labels: (n,) name that the main table gives the episode of each row; None: it gives none.
        partial: whether a row may lack a value, and a value may be late.
        ranges: whether a latency may be a range, which is to be estimated.

    Returns:
        The rows, and what was done; None: every value was measured at its row.

    Raises:
        ConfigError: rows are resampled, and a latency is no whole number of them.
        DataError: a latency is longer than an episode, clocks that run backwards or never meet, or rows have to be whole.
    """
    sensors = _sensors(config, model, mapping)
    if not ranges:
        _refuse_ranges(config, mapping)
    if not sensors:
        return rows, None
    good = values.usable(rows)
    kept = rows.take(good)
    clock.monotonic(kept, table, config)
    step = step_of(kept, model.dt)
    steps = np.diff(kept.time)[follows(kept)]
    equal = len(steps) == 0 or irregular_share(steps, step) == 0
    names = [*(q.name for q in model.states), *mapping.outputs]
    cells = np.concatenate([rows.states, rows.outputs], axis=1)
    late = np.zeros(cells.shape)
    said, incomplete = [], []
    for sensor in sensors:
        j = names.index(sensor.name)
        if sensor.latency:
            refuse_longer(kept, sensor.latency, sensor.key, step)
        count = round(sensor.latency / step)
        off = abs(sensor.latency / step - count)
        if not sensor.own_times and (off <= (TIE if partial else WHOLE)) and (equal or not partial):
            found = shifted(rows, cells[:, j], count, sensor.latency, step)
            cells[:, j] = found.values
            said.append(
                _told(sensor, found, 0, f"{sensor.name} is from {count} row{'s' * (count > 1)} before ({sensor.key})")
            )
            continue
        if not sensor.own_times and config.resample is not None:
            raise ConfigError(
                f"{sensor.key}: {sensor.latency:g} s is {sensor.latency / step:.4g} rows of {step:.4g} s: {_why(config)} A "
                "whole number of rows is taken here, too."
            )
        readings = _readings(sensor, rows, cells[:, j], table, mapping, joined, labels, config, TIE * step)
        found = placed(readings, kept, sensor.latency, step, config.max_gap)
        cells[:, j], late[:, j] = np.nan, 0.0
        cells[good, j], late[good, j] = found.values, found.late
        said.append(_told(sensor, found, readings.repeated, _source(sensor, readings)))
        if not partial and (why := _incomplete(found, kept, step)):
            incomplete.append(f"{sensor.name} ({sensor.said_by}) {why}")
    if incomplete:
        raise DataError(_needs_whole_rows(model, incomplete))
    if not partial:
        late[:] = 0.0
    n_states = len(model.states)
    rows = rows._replace(
        states=cells[:, :n_states], outputs=cells[:, n_states:], late=late if late.any() else np.empty((len(late), 0))
    )
    return rows, Check("when measured", True, "; ".join(said))


def _sensors(config: Measurements, model: Source, mapping: Mapping) -> list[_Sensor]:
    """Measured quantities whose values are not measured at their rows."""
    of_model = model.latency if isinstance(model, Model) else {}
    known = config.latency_over(of_model)
    found = []
    for name in [*(q.name for q in model.states), *mapping.outputs]:
        if name not in mapping.columns:
            continue
        key = f"data.latency.{name}" if name in config.latency else f"sim.outputs.{name}.delay"
        home = mapping.joined.get(name)
        if name in config.times and home is not None:
            raise ConfigError(
                f"data.times.{name}: column '{mapping.columns[name]}' is in the table of data.join[{home}], whose times are in "
                f"its key `time`. Leave data.times.{name} out."
            )
        sensor = _Sensor(name, known.get(name, 0.0), key, config.times.get(name), home)
        if sensor.latency or sensor.own_times:
            found.append(sensor)
    return found


def _readings(
    sensor: _Sensor,
    rows: Rows,
    own: np.ndarray,
    table: Table,
    mapping: Mapping,
    joined: Sequence[Joined],
    labels: np.ndarray | None,
    config: Measurements,
    tie: float,
) -> Readings:
    column = mapping.columns[sensor.name]
    if sensor.joined is not None:
        earlier = sensor.latency + tie
        return of_joined(joined[sensor.joined], column, rows, table, str(config.time), labels, earlier)
    if sensor.clock is not None:
        return by_clock(rows, own, table, str(config.time), sensor.clock, column, sensor.said_by)
    return at_rows(rows, own, column)


def _refuse_ranges(config: Measurements, mapping: Mapping) -> None:
    for name, (low, high) in config.latency_ranges().items():
        if name in mapping.columns:
            raise DataError(
                f"data.latency.{name}: [{low:g}, {high:g}] s is a range, which `simpel discover` estimates; here it has to "
                "be known. Give the number of seconds that discover found."
            )


def _incomplete(found: Placed, rows: Rows, step: float) -> str:
    """Say what keeps rows from being whole; empty: nothing does but for the ends of episodes."""
    between = int((found.late > EXACT * step).sum())
    if between:
        return f"was measured between rows in {between} of {len(rows.time)} rows"
    gone, inside = np.isnan(found.values), 0
    for name in dict.fromkeys(rows.episode.tolist()):
        own = gone[rows.episode == name]
        there = np.flatnonzero(~own)
        inside += int(own[there[0] : there[-1]].sum()) if len(there) else len(own)
    return f"has no value in {inside} of {len(rows.time)} rows" if inside else ""


def _needs_whole_rows(model: Source, incomplete: list[str]) -> str:
    if not model.states:
        return (
            f"rows are not complete: {'; '.join(incomplete)}. {model.name} has no states, so that nothing is known of what it "
            "does between rows. Give rows in which everything was measured at once."
        )
    return (
        f"rows are not complete: {'; '.join(incomplete)}. `simpel discover` takes such measurements as they are. Here every "
        "value has to be measured at its row: give a latency of a whole number of rows, or measure all at the same times."
    )


def _why(config: Measurements) -> str:
    if config.layout == "transitions":
        return (
            "rows of layout 'transitions' do not follow each other, so that a value cannot belong to another row. Store "
            "trajectories, or give values that were measured at their rows."
        )
    return (
        "data.resample brings rows to another dt, for which all values of a row have to be measured at once. Leave "
        "data.resample out and set sim.dt to the distance of the rows; `simpel discover` then takes every value at its time."
    )


def _source(sensor: _Sensor, readings: Readings) -> str:
    if not sensor.own_times:
        return f"{sensor.name} was measured {sensor.latency:g} s before its row ({sensor.key})"
    what = f"{readings.source}: {len(readings.time)} values"
    return what + (f", {sensor.latency:g} s late ({sensor.key})" if sensor.latency else "")


def _told(sensor: _Sensor, found: Placed, repeated: int, what: str) -> str:
    notes = [
        f"{count} {why}"
        for count, why in (
            (repeated, "repeat what the sensor said before"),
            (found.replaced, "left out, since a later one belongs to the same row"),
            (found.outside, "left out, since no row follows within a step"),
        )
        if count
    ]
    return f"{what} ({', '.join(notes)})" if notes else what
