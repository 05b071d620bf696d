"""Parts of a test whose errors are independent of each other, for intervals by resampling.

Parts are episodes. Of one or two of them, which have no interval, they are blocks of rows, of every channel as long as its
errors remember: a simulation that lost its way, as dead reckoning with a wrong heading does, is off by the same for the rest of
the episode, and ten blocks of that are one error and not ten.

Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations (blocks); Geyer (1992), Practical
Markov chain Monte Carlo, 3.3 (the integrated autocorrelation time).
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import correlate

from simpel_cli.filtering.measurements.windows import LEAST_EPISODES

BLOCKS = 10  # of a test window, where there are few episodes
NO_PART = -1
CORRELATED = 0.1  # autocorrelation below which errors are taken for independent
TIMES = 2.0  # correlation times that a block lasts at least


class Parts(NamedTuple):
    """Errors of two models, cut into parts.

    Args:
        before, after: (N, T, ny).
        parts: number of the part that each piece is of, per channel, (N, ny); NO_PART of a channel that has no interval: of
            fewer than three parts resampling says nothing.
    """

    before: np.ndarray
    after: np.ndarray
    parts: np.ndarray


def independent_parts(before: np.ndarray, after: np.ndarray, episode: np.ndarray) -> Parts:
    """Cut errors (W, T, ny) of two models on test windows into parts.

    Args:
        before: of one model.
        after: of the other.
        episode: that each window is of, (W,).
    """
    windows, rows, ny = before.shape
    if len(np.unique(episode)) >= LEAST_EPISODES:
        own = np.unique(episode, return_inverse=True)[1]
        return Parts(before, after, np.repeat(own[:, None], ny, axis=1))
    length = -(-rows // BLOCKS)
    first, second = cut = [_in_blocks(e, length) for e in (before, after)]
    parts = np.full((windows * BLOCKS, ny), NO_PART)
    for j in range(ny):
        together = max(1, int(np.ceil(TIMES * _memory(before[..., j], after[..., j]) / length)))
        own = np.arange(BLOCKS) // together
        there = np.isfinite([e[..., j] for e in cut]).any(axis=(0, 2))
        found = (np.arange(windows)[:, None] * BLOCKS + own).ravel()
        # without a memory, blocks are parts however few of them have an error
        if together == 1 or len(np.unique(found[there])) >= LEAST_EPISODES:
            parts[:, j] = found
    return Parts(first, second, parts)


def per_channel(parts: np.ndarray, channels: int) -> np.ndarray:
    """Return the parts (channels, W) of numbers per window, (W,), or per window and channel, (W, channels)."""
    return parts.T if parts.ndim == 2 else np.repeat(parts[None], channels, axis=0)


def correlation_time(errors: np.ndarray) -> float:
    """Return the integrated autocorrelation time of errors (W, T), rows, at least 1; NaN is no error."""
    e = np.where(np.isfinite(errors), errors, 0.0)
    rows = e.shape[1]
    lags = sum((correlate(row, row, method="fft")[rows - 1 :] for row in e), np.zeros(rows))
    if not lags[0] > 0:
        return 1.0
    r = lags / lags[0]
    end = int(np.argmax(r < CORRELATED)) or rows
    return max(1 + 2 * float(r[1:end].sum()), 1.0)


def _memory(before: np.ndarray, after: np.ndarray) -> float:
    """Return for how many rows the squared errors (W, T) of two models remember, beside their means.

    log(RMSE before / RMSE after) is, to first order, the mean of e_b^2 / (2 mean e_b^2) - e_a^2 / (2 mean e_a^2); the two RMSE
    have intervals of their own, so what remembers longest of these counts.
    """
    squares = [e**2 / mean for e in (before, after) if (mean := _mean(e**2)) > 0]
    of = [*squares, squares[0] - squares[1]] if len(squares) == 2 else squares
    return max((correlation_time(d - _mean(d)) for d in of), default=1.0)


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else 0.0


def _in_blocks(errors: np.ndarray, length: int) -> np.ndarray:
    windows, rows, ny = errors.shape
    padded = np.concatenate([errors, np.full((windows, BLOCKS * length - rows, ny), np.nan)], axis=1)
    return padded.reshape(windows * BLOCKS, length, ny)
