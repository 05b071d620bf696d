"""Whether what an effect gains comes from a few places of a recording, as from values that a sensor got wrong.

An end of a range that cuts off the two largest values, or a stop that is met once, explains these and nothing else; an outlier
does so, too, and is the simpler cause. What an effect gains by row is the difference of the log-likelihoods with and without
it. Without its best few places, and without as many that it loses most in, an effect that acts keeps most of that.

Reference: Huber and Ronchetti (2009), Robust statistics, 1.3 (trimmed sums).
"""

import numpy as np

PLACES = 3
REACH = 1  # rows before and behind that a place takes with it: a filter that was pulled away comes back
SPREAD = 0.5  # of the gain, that has to be left


def in_few_places(gains: np.ndarray, enough: float) -> bool:
    """Return whether the gain of an effect comes from a few places.

    Args:
        gains: by row, nats, (W, T).
        enough: nats that are enough for an effect without them, too.
    """
    total = float(gains.sum())
    left = total - _of_best(gains) + _of_best(-gains)
    return left < min(SPREAD * total, enough)


def _of_best(gains: np.ndarray) -> float:
    """Return what the best places gain together."""
    rest, found = gains.copy(), 0.0
    for _ in range(PLACES):
        w, k = np.unravel_index(int(np.argmax(rest)), rest.shape)
        place = slice(max(k - REACH, 0), k + REACH + 1)
        found += max(float(rest[w, place].sum()), 0.0)
        rest[w, place] = 0.0
    return found
