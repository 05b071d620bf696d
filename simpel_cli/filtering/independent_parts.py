"""Parts of a test whose errors are independent of each other, for intervals by resampling.

Parts are episodes. Of one or two of them, which have no interval, they are blocks of rows, of every channel as long as its
errors remember, where there are five of these: a simulation that lost its way, as dead reckoning with a wrong heading does, is
off by the same for the rest of the episode, and ten blocks of that are one error and not ten.

Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations (blocks); Geyer (1992), Practical
Markov chain Monte Carlo, 3.3 (the integrated autocorrelation time); Isserlis (1918) for the squares of Gaussian series.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import correlate

from simpel_cli.filtering.measurements.windows import LEAST_EPISODES

BLOCKS = 10  # of a test window, where there are few episodes
LEAST = 5  # blocks with an error: of fewer, resampling says too little
NO_PART = -1
CORRELATED = 0.1  # autocorrelation below which errors are taken for independent
TIMES = 2.0  # correlation times that a block lasts at least


class Parts(NamedTuple):
    """Errors of two models, cut into parts.

    Args:
        before, after: (N, T, ny).
        parts: number of the part that each piece is of, per channel, (N, ny); NO_PART where there is no error, and of a
            channel that has too few parts for an interval.
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
        parts = np.repeat(own[:, None], ny, axis=1)
        for j in range(ny):  # a sensor that speaks in one of many episodes has one ratio, and no interval
            known = np.isfinite([before[..., j], after[..., j]]).any(axis=(0, 2))
            if len(np.unique(own[known])) < LEAST_EPISODES:
                parts[:, j] = NO_PART
        return Parts(before, after, parts)
    there = np.asarray(np.isfinite([before, after]).any(axis=(0, 1, 3)))  # none has an error before its horizon
    if there.any():
        begin, end = int(np.argmax(there)), rows - int(np.argmax(there[::-1]))
        before, after, rows = before[:, begin:end], after[:, begin:end], end - begin
    length = -(-rows // BLOCKS)
    first, second = cut = [_in_blocks(e, length) for e in (before, after)]
    parts = np.full((windows * BLOCKS, ny), NO_PART)
    for j in range(ny):
        most = min(BLOCKS, int(rows / (TIMES * _memory(before[..., j], after[..., j]))))
        own = (np.arange(windows)[:, None] * BLOCKS + np.arange(BLOCKS) * most // BLOCKS).ravel()
        known = np.isfinite([e[..., j] for e in cut]).any(axis=(0, 2))
        if len(np.unique(own[known])) >= LEAST:
            parts[known, j] = own[known]
    return Parts(first, second, parts)


def per_channel(parts: np.ndarray, channels: int) -> np.ndarray:
    """Return the parts (channels, W) of numbers per window, (W,), or per window and channel, (W, channels)."""
    return parts.T if parts.ndim == 2 else np.repeat(parts[None], channels, axis=0)


def correlation_time(errors: np.ndarray) -> float:
    """Return the integrated autocorrelation time of errors (W, T), rows, at least 1; NaN is no error."""
    r = autocorrelation(errors)
    end = int(np.argmax(r < CORRELATED)) or len(r)
    return max(1 + 2 * float(r[1:end].sum()), 1.0)


def autocorrelation(errors: np.ndarray) -> np.ndarray:
    """Return the autocorrelation of errors (W, T) about 0 at every lag, (T,); 1 at lag 0 alone where there is no error."""
    e = np.where(np.isfinite(errors), errors, 0.0)
    rows = e.shape[1]
    lags = sum((correlate(row, row, method="fft")[rows - 1 :] for row in e), np.zeros(rows))
    return lags / lags[0] if lags[0] > 0 else np.eye(1, rows)[0]


def _memory(before: np.ndarray, after: np.ndarray) -> float:
    """Return for how many rows the squared errors (W, T) of two models remember, that of the one that remembers longer.

    Squares of a Gaussian series of mean 0 are correlated by r^2, r the autocorrelation of the series itself. How the squares
    of these few rows go would be no measure: those of a swing come and go, and all hang on how the swing began.
    """
    return max(_of_squares(e) for e in (before, after))


def _of_squares(errors: np.ndarray) -> float:
    return 1 + 2 * float(np.sum(autocorrelation(errors)[1:] ** 2))


def _in_blocks(errors: np.ndarray, length: int) -> np.ndarray:
    windows, rows, ny = errors.shape
    padded = np.concatenate([errors, np.full((windows, BLOCKS * length - rows, ny), np.nan)], axis=1)
    return padded.reshape(windows * BLOCKS, length, ny)
