"""The white noise of a measured position, and its rows in equal steps."""

from collections.abc import Sequence
from math import comb

import numpy as np

WHITE = 0.7  # white noise has the same level at orders 4 and 8; a smooth signal loses it, a coarsely sampled one gains
USUAL = 1.5  # times the median step: a longer one has a gap in it
LONGEST_PAUSE = 11  # rows that a filter may read
FAR = 4.0  # times the median size: no noise
NORMAL = 0.6745  # median of the size of a normal variable of unit variance


def on_grid(t: np.ndarray, p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows in equal steps, NaN where some are missing; stamps may be rounded, and no filter looks over a long pause."""
    steps = np.diff(t)
    usual = steps[steps < USUAL * np.median(steps)]
    step = float(np.mean(usual)) if usual.size else float(np.median(steps))
    rows = np.clip(np.rint(steps / step), 1, LONGEST_PAUSE) if step > 0 else np.ones(len(steps))
    k = np.concatenate([[0], np.cumsum(rows)]).astype(int)
    both = np.full((2, k[-1] + 1), np.nan)
    both[:, k] = p, v
    return both[0], both[1]


def white_level(signals: Sequence[np.ndarray], order: int, *, mean: bool = False) -> float:
    """Standard deviation of the white noise that differences of some order would come from.

    Args:
        signals: each (T,); NaN where a value is missing.
        order: of the differences.
        mean: by their mean square within four times their median, in place of their median.
    """
    found = np.concatenate([np.diff(s, order) for s in signals])
    found = np.abs(found[np.isfinite(found)])
    if not len(found):
        return 0.0
    middle = float(np.median(found))
    size = float(np.sqrt(np.mean(found[found <= FAR * middle] ** 2))) if mean else middle / NORMAL
    return size / float(np.sqrt(comb(2 * order, order)))
