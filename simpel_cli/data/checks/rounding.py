"""The step to which the values of a column were rounded, whether or not its noise hides that: a lower bound of its noise.

A converter of finite steps gives multiples of a step. What is stored is often rounded once more, to decimals, so that values
scatter about those multiples; the characteristic function of values and of changes finds the step all the same. What moves
by even steps, as at a constant speed, is no converter: its noise is far below the error of rounding to such steps.
"""

from collections.abc import Sequence

import numpy as np

from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.data.checks.sensors import FEW_RUNS, changes, quantum

MOST_DIGITS = 9  # after the decimal point
WHOLE = 1e-6  # of a decimal step
SINGLE = 1e-7  # of a value: numbers of single precision
FEW_LEVELS = 3  # different values, or changes in steps: fewer are a coincidence
COHERENT = 0.45  # of changes that are multiples of a step; of others it is below 0.3 at any step
OF_EXPECTED = 0.85  # of the coherence that rounding to decimals leaves
FINEST, GRID = 2.5, 4000  # decimal steps; tried steps, evenly in the logarithm
OF_NOISE = 1.3  # times what third differences say is the error of rounding at most


def rounding(pieces: Sequence[np.ndarray]) -> float:
    """Return the step to which values were rounded; NaN: none was found.

    Args:
        pieces: contiguous rows, angles unwrapped, each (T,).
    """
    step = quantum(pieces)
    if np.isfinite(step):
        return step
    values = np.concatenate([piece[np.isfinite(piece)] for piece in pieces]) if pieces else np.empty(0)
    decimal = _decimal(values)
    if not np.isfinite(decimal):
        return decimal
    most = OF_NOISE * 12**0.5 * third_difference_std(pieces)
    converter = _converter(values, changes(pieces), decimal)
    return converter if converter <= most else decimal


def _decimal(values: np.ndarray) -> float:
    """Return the power of ten of which all values are multiples; NaN where there is none."""
    if len(np.unique(values)) < FEW_LEVELS:
        return float("nan")
    size, span = float(np.max(np.abs(values))), float(np.ptp(values))
    for digits in range(-int(np.floor(np.log10(span))), MOST_DIGITS + 1):
        steps = values * 10.0**digits
        exact = max(WHOLE, SINGLE * size * 10.0**digits)
        if exact > 0.01:  # finer steps than these numbers can show
            break
        if np.all(np.abs(steps - np.round(steps)) < exact) and len(np.unique(np.round(steps))) >= FEW_LEVELS:
            return float(10.0**-digits)
    return float("nan")


def _converter(values: np.ndarray, sizes: np.ndarray, decimal: float) -> float:
    """Return the step of a converter whose values were rounded to decimals once more; NaN where there is none.

    |E exp(2 pi i x/q)| of values x, and of their changes, is 1 where they are multiples of q. An error of rounding, uniform in
    a decimal step d, leaves sinc(d/q) of it, two of them its square.
    """
    most = 1.2 * float(np.median(sizes)) if len(sizes) >= FEW_RUNS else 0.0  # any change is small beside a large step
    if most <= FINEST * decimal:
        return float("nan")
    tried = np.geomspace(FINEST * decimal, most, GRID)
    found = np.array([np.exp(2j * np.pi * sizes / q).mean().real for q in tried])
    share = found / np.sinc(decimal / tried) ** 2
    best = int(np.argmax(np.where(found > COHERENT, share, 0.0)))
    if found[best] <= COHERENT or share[best] <= OF_EXPECTED:
        return float("nan")
    # values are many steps long: about the step that changes tell, which they tell much better
    near = tried[best] * np.linspace(0.97, 1.03, GRID)
    whole = np.array([np.abs(np.exp(2j * np.pi * values / q).mean()) for q in near]) / np.sinc(decimal / near)
    k = int(np.argmax(whole))
    counts = np.unique(np.round(sizes / near[k]), return_counts=True)[1]
    return (
        float(near[k]) if whole[k] > OF_EXPECTED and np.sum(counts > 0.05 * len(sizes)) >= FEW_LEVELS else float("nan")
    )
