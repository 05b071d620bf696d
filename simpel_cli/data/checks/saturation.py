"""Values at the ends of what a sensor records: the quantity is known only to be there or beyond.

Of an output such a value stays, and counts as what it says (`inference.censored`). Of a state it is taken for missing: a
transition begins and ends at values, not at inequalities.
"""

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check, Source
from simpel_cli.data.rows import Mapping, Rows
from simpel_cli.errors import DataError

ROUNDING = 1e-9  # of the span, by which a recorded end may differ from the declared one


def saturation(config: Measurements, model: Source, rows: Rows, mapping: Mapping) -> tuple[Check, Rows]:
    """Find values at the ends of declared sensors.

    Args:
        config: `sensor`.
        model: names the states.
        rows: of the file, not yet cut.
        mapping: measured quantities.

    Returns:
        The check, and rows with `beyond`; in them an output at an end is the end itself, a state NaN.

    Raises:
        DataError: values lie beyond the ends, or values at an end are to be resampled.
    """
    states = [q.name for q in model.states]
    names, ends = [*states, *mapping.outputs], config.ends()
    cells = np.concatenate([rows.states, rows.outputs], axis=1)
    following = rows.next_states.copy()
    beyond, said = np.zeros(cells.shape), []
    for j, name in enumerate(names):
        if name not in ends or name not in mapping.columns:
            continue
        low, high = ends[name]
        beyond[:, j] = _sides(name, cells[:, j], low, high)
        share = float(np.mean(beyond[:, j] != 0)) if len(cells) else 0.0
        told = f"{name} {share:.2%} (low {np.sum(beyond[:, j] < 0)}, high {np.sum(beyond[:, j] > 0)})"
        if j < len(states):
            cells[beyond[:, j] != 0, j] = np.nan
            if following.shape[1]:
                following[_sides(name, following[:, j], low, high, "next ") != 0, j] = np.nan
            said.append(f"{told}, taken for missing values: it is a state" if share else told)
            continue
        cells[:, j] = np.where(beyond[:, j] < 0, low, np.where(beyond[:, j] > 0, high, cells[:, j]))
        if share and config.resample is not None:
            raise DataError(
                f"data.resample: {share:.2%} of the values of {name} lie at an end of its sensor, "
                f"data.sensor.{name}.saturates. A filter would spread them over their neighbours. Set sim.dt to the time step "
                "of the data, and data.resample: null."
            )
        said.append(told)
    rows = rows._replace(
        states=cells[:, : len(states)], outputs=cells[:, len(states) :], next_states=following, beyond=beyond
    )
    return Check("saturation", True, "; ".join(said) or "no declared sensor is read"), rows


def _sides(name: str, values: np.ndarray, low: float, high: float, which: str = "") -> np.ndarray:
    """Return -1 where values lie at the low end, 1 at the high one, else 0, (n,)."""
    known = values[np.isfinite(values)]
    span = high - low if np.isfinite(high - low) else float(np.ptp(known)) if len(known) else 0.0
    slack = ROUNDING * span
    off = known[(known < low - slack) | (known > high + slack)]
    if len(off):
        ends = ", ".join(f"{end:g}" if np.isfinite(end) else "null" for end in (low, high))
        raise DataError(
            f"data.sensor.{name}.saturates: [{ends}], but {len(off)} of {len(known)} {which}values of {name} lie beyond, from "
            f"{off.min():.6g} to {off.max():.6g}: the sensor records nothing there. Correct the ends, in the unit of "
            f"{name}, or remove these values."
        )
    found: np.ndarray = np.where(values <= low + slack, -1.0, 0.0) + np.where(values >= high - slack, 1.0, 0.0)
    return found
