"""Measurement noise from the data alone."""

from collections.abc import Sequence

import numpy as np

MIN_ROWS = 8  # of an episode, for five third differences


def third_difference_std(episodes: Sequence[np.ndarray]) -> float:
    """Standard deviation of white noise on smooth signals.

    Third differences remove whatever is quadratic over four rows and turn noise of variance s^2 into 20 s^2
    (1 + 9 + 9 + 1):  s^2 = sum(d3^2) / 20 / n. The median over episodes keeps one with a shock from setting it.
    What the signal does faster than that counts as noise, so coarse sampling gives an upper bound.

    Args:
        episodes: one quantity, each (T,), equal steps, angles unwrapped; NaN where a value is missing.

    Returns:
        In the quantity's unit; NaN where no episode has `MIN_ROWS` rows.
    """
    pieces = [run for signal in episodes for run in runs(signal)]
    if not any(
        len(run) >= MIN_ROWS for run in pieces
    ):  # a sensor that speaks now and then: its own values follow each other
        pieces = [signal[np.isfinite(signal)] for signal in episodes]
    variances = [float(np.mean(np.diff(run, 3) ** 2)) / 20 for run in pieces if len(run) >= MIN_ROWS]
    return float(np.sqrt(np.median(variances))) if variances else float("nan")


def runs(signal: np.ndarray) -> list[np.ndarray]:
    """Contiguous values of a signal between those that are missing."""
    gone = np.flatnonzero(~np.isfinite(signal))
    return [part[np.isfinite(part)] for part in np.split(signal, gone)] if len(gone) else [signal]
