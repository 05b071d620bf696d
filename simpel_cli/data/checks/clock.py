"""Time stamps: their order within an episode, and the sampling step against the simulator's."""

import math

import numpy as np

from simpel_cli.data.checks.sensors import IRREGULAR_SHARE, irregular_share
from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check, Source
from simpel_cli.data.rows import Rows, follows, same_episode
from simpel_cli.data.tables.table import Table
from simpel_cli.data.time_gaps import _bridge
from simpel_cli.errors import ConfigError, DataError

DT_TOLERANCE = 0.02  # relative; a larger difference is another sampling time, not jitter
FAR = 10.0  # times the simulator's dt, or less than a tenth: another unit rather than irregular rows
MAX_UPSAMPLING = 10.0  # new rows per measured row; more are refused


def monotonic(rows: Rows, table: Table, config: Measurements) -> Check:
    """Refuse time that stands still or runs backwards within an episode.

    Raises:
        DataError: names row, episode and the two times.
    """
    back = (np.diff(rows.time) <= 0) & same_episode(rows)
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


def sampling(
    rows: Rows, model: Source, config: Measurements, *, as_they_are: bool = False
) -> tuple[Check, float, float]:
    """Compare the distance of the rows with the simulator's dt.

    Args:
        rows: in the order of time within every episode.
        model: the simulator.
        config: `resample`.
        as_they_are: rows at irregular times are allowed, since what comes goes from one time to the next.

    Returns:
        The check, the dt of the data, s (median), and the longest usual step, s: a longer one may be a gap.

    Raises:
        ConfigError: data.resample is not the simulator's dt.
        DataError: too few rows, or a dt that is not the simulator's.
    """
    if config.resample is not None and not math.isclose(config.resample, model.dt, rel_tol=1e-3):
        raise ConfigError(
            f"data.resample: {config.resample:g} s is not the dt of simulator '{model.name}'. "
            f"Set data.resample: {model.dt:g}, or sim.dt: {config.resample:g}."
        )
    steps = np.diff(rows.time)[follows(rows)]
    if len(steps) == 0 and not model.states and config.resample is None:
        return Check("sampling", True, "every row is an episode of its own"), model.dt, model.dt
    if len(steps) == 0:
        raise DataError(f"too few rows: none of {len(rows.time)} rows follows another in the same episode.")
    dt = float(np.median(steps))
    in_ms = " The time looks like ms, but it is read in s." if math.isclose(dt, 1e3 * model.dt, rel_tol=0.02) else ""
    if config.resample is not None and dt > MAX_UPSAMPLING * model.dt:
        raise DataError(
            f"the rows are {dt:.4g} s apart: resampling to {model.dt:g} s would interpolate most rows.{in_ms} "
            f"Record faster, or set sim.dt: {dt:.4g} and data.resample: null."
        )
    if as_they_are and irregular_share(steps, dt) > IRREGULAR_SHARE and 1 / FAR < dt / model.dt < FAR:
        longest = max(dt, model.dt, float(np.percentile(steps, 99)))
        detail = (
            f"irregular steps, median {dt:.4g} s, 1st to 99th percentile {np.percentile(steps, 1):.3g} to "
            f"{np.percentile(steps, 99):.3g} s: every row keeps its time"
        )
        return Check("sampling", True, detail), dt, longest
    if config.resample is None and model.states and abs(dt / model.dt - 1) > DT_TOLERANCE:
        bridge, why = "", ""
        if irregular_share(steps, dt) > IRREGULAR_SHARE:
            bridge = _bridge(steps, 1.5 * max(dt, model.dt), " and ")
            why = " (median; the steps are irregular)"
        raise DataError(
            f"the rows are {dt:.4g} s apart{why}, but simulator '{model.name}' has dt = {model.dt:g} s.{in_ms} "
            f"Resample the data with data.resample: {model.dt:g}{bridge}, or set sim.dt: {dt:.4g}."
        )
    return Check("sampling", True, f"dt {dt:.4g} s"), dt, dt
