"""The step to which the values of a column were rounded, whether or not its noise hides that: a lower bound of its noise.

A converter of finite steps gives multiples of a step. What is stored is often rounded once more, to decimals, so that the
changes scatter about those multiples; the characteristic function of the changes finds the step all the same.
"""

from collections.abc import Sequence

import numpy as np

from simpel_cli.data.checks.sensors import FEW_RUNS, changes, quantum

MOST_DIGITS = 9  # after the decimal point
WHOLE = 1e-4  # of a decimal step
COHERENT = 0.45  # of changes that are multiples of a step; of others it is below 0.3 at any step
OF_EXPECTED = 0.85  # of the coherence that rounding to decimals leaves
FINEST, GRID = 2.5, 4000  # decimal steps; tried steps, evenly in the logarithm


def rounding(pieces: Sequence[np.ndarray]) -> float:
    """Return the step to which values were rounded; NaN: none was found.

    Args:
        pieces: contiguous rows, angles unwrapped, each (T,).
    """
    step = quantum(pieces)
    if np.isfinite(step):
        return step
    decimal = _decimal([piece[np.isfinite(piece)] for piece in pieces])
    converter = _converter(changes(pieces), decimal) if np.isfinite(decimal) else np.nan
    return converter if np.isfinite(converter) else decimal


def _decimal(pieces: Sequence[np.ndarray]) -> float:
    """Return the power of ten of which all values are multiples; NaN where there is none."""
    values = np.concatenate(pieces) if pieces else np.empty(0)
    if len(values) < FEW_RUNS:
        return float("nan")
    size = max(float(np.max(np.abs(values))), 1e-300)
    for digits in range(-int(np.floor(np.log10(size))), MOST_DIGITS + 1):
        steps = values * 10.0**digits
        if np.all(np.abs(steps - np.round(steps)) < WHOLE):
            return float(10.0**-digits)
    return float("nan")


def _converter(sizes: np.ndarray, decimal: float) -> float:
    """Return the step of a converter whose values were rounded to decimals once more; NaN where there is none.

    |E exp(2 pi i c/q)| of the changes c is 1 where they are multiples of q. Two errors of rounding, uniform in a decimal
    step d, leave sinc(d/q)^2 of it.
    """
    most = 1.2 * float(np.median(sizes)) if len(sizes) >= FEW_RUNS else 0.0  # any change is small beside a large step
    if most <= FINEST * decimal:
        return float("nan")
    tried = np.geomspace(FINEST * decimal, most, GRID)
    found = np.array([np.abs(np.exp(2j * np.pi * sizes / q).mean()) for q in tried])
    share = found / np.sinc(decimal / tried) ** 2
    best = int(np.argmax(np.where(found > COHERENT, share, 0.0)))
    return float(tried[best]) if found[best] > COHERENT and share[best] > OF_EXPECTED else float("nan")
