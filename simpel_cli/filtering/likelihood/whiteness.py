"""Whether one-step errors are white: what a right model leaves behind has no memory.

    r_l = sum_k e[k] e[k+l] / sum_k e[k]^2,    |r_l| < 1.96/sqrt(n)
    C(f) = sum of the periodogram up to f / its total,    |C(f) - 2f| < 1.358/sqrt(M) for M frequencies

Reference: Box, Jenkins and Reinsel (2008), Time series analysis, ch. 8 (the cumulated periodogram after Bartlett, 1955).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

Z95 = 1.959963984540054
KOLMOGOROV95 = 1.3581  # quantile of the supremum of a Brownian bridge
LAGS = 20
MEMORY_NATS, MEMORY_LEAST = 12.0, 0.2  # n r_1^2/2, and r_1, from which on errors are said to follow each other
SWING_LEAST, SWING_CHANCE = 0.1, 1e-5  # of all r_l^2 together, beyond what chance adds, and the chance of as much


class Correlation(NamedTuple):
    """Autocorrelation of a signal.

    Args:
        lag: (L,) rows.
        value: (L,).
        band: half width within which 95 % of a white signal's values lie.
    """

    lag: np.ndarray
    value: np.ndarray
    band: float


class Cumulated(NamedTuple):
    """Cumulated periodogram of a signal.

    Args:
        frequency: (M,) in cycles per row, up to 1/2.
        value: (M,) share of the power up to there; a white signal's is 2 f.
        band: half width within which all of a white signal's curve lies, with 95 % probability.
    """

    frequency: np.ndarray
    value: np.ndarray
    band: float


def autocorrelation(episodes: Sequence[np.ndarray], lags: int = LAGS) -> Correlation | None:
    """Return the autocorrelation of a signal in several pieces; NaN = not measured. None where there is too little.

    Args:
        episodes: (T,) each, standardised; pairs are formed within a piece only.
        lags: largest lag.
    """
    n = sum(int(np.isfinite(e).sum()) for e in episodes)
    lags = min(lags, max((len(e) for e in episodes), default=0) - 2, n // 4)
    power = sum(float(np.nansum(e**2)) for e in episodes)
    if lags < 1 or power == 0:
        return None
    values = [sum(float(np.nansum(e[:-lag] * e[lag:])) for e in episodes if len(e) > lag) for lag in range(1, lags + 1)]
    return Correlation(np.arange(1, lags + 1), np.array(values) / power, Z95 / np.sqrt(n))


def cumulated_periodogram(episodes: Sequence[np.ndarray]) -> Cumulated | None:
    """Return the cumulated periodogram of a signal in several pieces, all frequencies pooled; None where too little.

    Args:
        episodes: (T,) each, standardised; NaN = not measured, and counts as 0.
    """
    pairs = []
    for episode in episodes:
        e = np.nan_to_num(episode)
        n = len(e)
        count = (n - 1) // 2
        if count < 2 or not e.any():
            continue
        power = np.abs(np.fft.rfft(e)[1 : count + 1]) ** 2 / n
        pairs.append(np.stack([np.arange(1, count + 1) / n, power]))
    if not pairs:
        return None
    frequency, power = np.concatenate(pairs, axis=1)
    order = np.argsort(frequency, kind="stable")
    total = np.cumsum(power[order])
    return Cumulated(frequency[order], total / total[-1], KOLMOGOROV95 / np.sqrt(len(frequency)))


def memory(errors: np.ndarray) -> tuple[float, int] | None:
    """Return the correlation of one-step errors with those some rows before, and how many, where they have one, else None.

    A force that the filter has to follow row after row, since it is no function of states or inputs, leaves errors that
    follow each other; one that swings with time leaves errors that come again. Process noise that is white does neither.

    Args:
        errors: (W, T) standardised, windows by rows.

    Reference: Box and Pierce (1970), Distribution of residual autocorrelations.
    """
    from scipy.stats import chi2

    found = autocorrelation(list(errors))
    if found is None:
        return None
    n, r = int(np.isfinite(errors).sum()), found.value
    if r[0] > MEMORY_LEAST and n * r[0] ** 2 / 2 > MEMORY_NATS:
        return float(r[0]), 1
    later = r[1:]  # a differentiated column has errors that take back the one before
    together = float(np.sum(later**2))
    if together - len(later) / n < SWING_LEAST or chi2.sf(n * together, len(later)) > SWING_CHANCE:
        return None
    lag = int(np.argmax(np.abs(later)))
    return float(later[lag]), lag + 2
