"""What the values of a column tell of its noise, before any filter."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.checks import sensors
from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.data.checks.rounding import rounding
from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check, Episode, Source
from simpel_cli.data.rows import Mapping

OF_STEP = 12**-0.5  # standard deviation of rounding, of a step


class Told(NamedTuple):
    """What columns tell of their noise, by state and output.

    Args:
        std: standard deviation, declared or estimated.
        least: that of rounding, which no estimate can be below.
        steps: that the noise comes from, where it does.
    """

    std: dict[str, float]
    least: dict[str, float]
    steps: dict[str, float]


def column_noise(config: Measurements, model: Source, mapping: Mapping, train: Sequence[Episode]) -> Told:
    """Standard deviation of the noise per measured state and output, declared or estimated, before any filter.

    Third differences of values that repeat say almost nothing: an estimate is at least step/sqrt(12), the error of rounding.
    """
    names = [q.name for q in model.states] + list(mapping.outputs)
    told = Told({}, {}, {})
    for i, name in enumerate(names):
        if name not in mapping.columns:
            continue
        columns = [inside(episode, i) for episode in train]
        there = [values[np.isfinite(values)] for values in columns]
        value = config.noise_std.get(name)
        if value is None:
            step = sensors.coarse_step(there)
            value = third_difference_std(columns)
            if step * OF_STEP > value:
                value = step * OF_STEP
                told.steps[name] = step
            least = rounding(there) * OF_STEP
            if np.isfinite(least) and np.isfinite(value):
                told.least[name] = min(least, value)
        if np.isfinite(value):
            told.std[name] = float(value)
    return told


def noise_check(config: Measurements, model: Source, told: Told) -> Check:
    """Say what the noise of every column is."""
    units = {q.name: q.unit for q in (*model.states, *model.outputs)}

    def said(name: str, std: float) -> str:
        value = f"{config.noise_std.get(name, std):.3g} {units[name]}".rstrip()
        if name in config.noise_std:
            return f"{name} {value} (declared)"
        return f"{name} {value}" + (f" (rounding to steps of {told.steps[name]:.3g})" if name in told.steps else "")

    shown = [said(name, std) for name, std in told.std.items()]
    return Check("noise", bool(shown), ", ".join(shown) if shown else "too few rows to estimate it")


def column(episode: Episode, i: int) -> np.ndarray:
    """Values of a state, or behind them an output, (T,)."""
    values: np.ndarray = np.concatenate([episode.states, episode.outputs], axis=1)[:, i]
    return values


def inside(episode: Episode, i: int) -> np.ndarray:
    """Values of a state or an output, NaN where they lie at an end of their sensor, (T,)."""
    values = column(episode, i)
    return values if episode.beyond is None else np.where(episode.beyond[:, i] != 0, np.nan, values)
