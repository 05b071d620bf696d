"""Which column is the time, in which unit, and where it starts anew."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.importing.columns import Column
from simpel_cli.data.unit_words import canonical

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
NAMED = re.compile(
    r"(?:t|time|times|timestamp|stamp|clock|elapsed|zeit|temps|tiempo|tempo)(?:_?(?P<unit>s|sec|ms|us|ns|min|h))?"
    r"|(?P<alone>sec|secs|seconds|ms|millis|milliseconds)"
)
ALONE = {"sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "millis": "ms", "milliseconds": "ms"}
MOST_STARTS = 1 / 3  # of the rows; a column that goes back more often is no time
FITS = 0.02  # relative, of the simulator's dt
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # size of a time since 1970, today
LONG = 0.5  # s between rows; whole numbers so far apart may be ms


class Clock(NamedTuple):
    """The time.

    Args:
        column: its name; None: there is none, or it is not sure which.
        unit: of the column.
        dt: median of its steps, in s.
        irregular: share of the steps that differ from it by more than 2 %.
        gaps: number of steps longer than 1.5 dt.
        starts: rows at which it starts anew within a file, (k,).
        questions: what only a person can tell.
    """

    column: str | None
    unit: str = "s"
    dt: float | None = None
    irregular: float = 0.0
    gaps: int = 0
    starts: np.ndarray = np.empty(0, int)
    questions: tuple[str, ...] = ()

    @property
    def factor(self) -> float:
        """From the column to s."""
        return SECONDS[self.unit]


def clock_of(columns: Sequence[Column], file: np.ndarray, dt: float | None) -> Clock:
    """Find the time.

    Args:
        columns: all of them.
        file: which file a row is from, (n,).
        dt: of the simulator, s, if there is one.
    """
    rising = [column for column in columns if _rises(column, file)]
    named = [c for c in rising if _named(c.name) is not None or canonical(c.unit) in SECONDS]
    exact = [c for c in named if c.name.lower() in ("t", "time")]
    chosen = named if len(named) == 1 else exact
    if len(chosen) == 1:
        others = [c.name for c in named if c is not chosen[0]]
        also = (f"{', '.join(others)} could be the time as well. Is it {chosen[0].name}?",) if others else ()
        return _described(chosen[0], file, dt, also)
    names = ", ".join(c.name for c in named or rising)
    if named:
        question = f"Which column is the time: {names}? Write e.g. `time: {named[0].name}`. Until then a row is one dt."
    elif rising:
        which = names if len(rising) == 1 else f"one of {names}"
        question = (
            f"Is {which} the time? No name says so. If it is: `time: {rising[0].name}`. Until then a row is one dt."
        )
    else:
        question = (
            "No column increases as a time does. If the rows are evenly spaced, leave `time` out: a row is one dt."
        )
    return Clock(None, questions=(question,))


def _described(column: Column, file: np.ndarray, dt: float | None, questions: tuple[str, ...]) -> Clock:
    assert column.values is not None
    steps = np.diff(column.values)
    inside = file[1:] == file[:-1]
    forward = inside & (steps > 0)
    usual = float(np.median(steps[forward]))
    unit, doubt = _unit(column, usual, dt)
    return Clock(
        column.name,
        unit,
        usual * SECONDS[unit],
        float(np.mean(np.abs(steps[forward] / usual - 1) > 0.02)),
        int(np.sum(steps[forward] > 1.5 * usual)),
        np.flatnonzero(inside & (steps <= 0)) + 1,
        (*questions, *doubt),
    )


def _unit(column: Column, usual: float, dt: float | None) -> tuple[str, tuple[str, ...]]:
    """Unit of the time: declared, in the name, by its size if since 1970, by the simulator's dt; else s, perhaps in doubt."""
    declared = canonical(column.unit)
    if declared in SECONDS:
        return declared, ()
    name = _named(column.name)
    if name:
        return name, ()
    assert column.values is not None
    size = float(np.median(np.abs(column.values)))
    for least, unit in EPOCHS:
        if size > least:
            return unit, ()
    if dt is not None:
        for unit, factor in SECONDS.items():
            if abs(usual * factor / dt - 1) < FITS:
                return unit, ()
    whole = bool(np.all(column.values == np.round(column.values)))
    if whole and usual > LONG:
        question = f"Is {column.name} in s or in ms? Its steps are {usual:.6g}, and no unit is given; it is read in s."
        if column.name.replace(".", "_").isidentifier():
            question += f" If it is in ms: `computed: {{time_s: {column.name}/1000}}` and `time: time_s`."
        return "s", (question,)
    return "s", ()


def _rises(column: Column, file: np.ndarray) -> bool:
    values = column.values
    if values is None or len(values) < 3 or not np.isfinite(values).all():
        return False
    steps = np.diff(values)[file[1:] == file[:-1]]
    back = steps <= 0
    return bool(len(steps) > 0 and back.mean() <= MOST_STARTS and (steps[back] < 0).all())


def _named(name: str) -> str | None:
    """Unit in a name that is one of a time, empty if it has none; None: the name is of something else."""
    match = NAMED.fullmatch(re.split(r"[./]", name)[-1].strip().lower())
    if match is None:
        return None
    unit = match["unit"] or ALONE.get(match["alone"] or "", "")
    return "s" if unit == "sec" else unit
