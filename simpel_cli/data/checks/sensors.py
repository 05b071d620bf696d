"""Faults of sensors and clocks that can be seen in one column: held samples, coarse steps, irregular time stamps.

They are tested before the search for effects: a sensor that holds its value resembles a delay, a coarse one
friction. Every function takes contiguous pieces of a column and is free of the simulator.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.data.recording import Check

STALE_SHARE = 0.05  # of the rows; fewer repeats are what a quantised sensor gives
JUMP = 4.0  # smallest changes; a value that repeats between larger ones was held, since a new one would have changed
SMALL = 0.25  # of the median change; a smaller one before a repeat is a motion that comes to rest
LONG = 5.0  # times the usual length of a repeat
FEW_RUNS = 5  # fewer repeats, or changes, are not enough for a test
COARSE = 2.5  # quanta per standard deviation of the noise: beyond, rounding is the larger error
FEW_LEVELS = 1000  # over the whole span; finer steps are finer than anything that is learned
GRID_SHARE = 0.98  # of the steps that are whole multiples of the quantum; the rest are angles that wrapped
IRREGULAR = 0.02  # of dt; a step that differs by more is irregular
IRREGULAR_SHARE = 0.05  # of the steps


def stale(signals: Mapping[str, Sequence[np.ndarray]]) -> Check:
    """Find sensors that repeat a value while the quantity moves on.

    A run of equal values counts where the changes before and after it are both larger than `JUMP` times the smallest:
    a quantised sensor repeats values too, but only where the motion is slower than a step per row. Rest does not count.

    Args:
        signals: name -> contiguous pieces of its column, each (T,).
    """
    found = []
    for name, pieces in signals.items():
        share, rows = held(pieces)
        if share > STALE_SHARE:
            found.append(
                f"{name} repeats its last value in {share:.0%} of the rows while the quantity changes, "
                f"{rows:.0f} rows at a time"
            )
    if not found:
        return Check("stale", True, "no sensor repeats its last value while the quantity changes")
    cure = (
        "If the sensor is slower: set sim.dt and data.resample to its sampling time; otherwise remove the repeated rows"
    )
    return Check("stale", False, f"{'; '.join(found)}. {cure}")


def quantisation(signals: Mapping[str, Sequence[np.ndarray]], units: Mapping[str, str]) -> Check:
    """Find sensors whose steps are coarser than their noise.

    Rounding to steps of q adds an error of q/sqrt(12) that is not white where the quantity moves slowly. It is reported
    where `coarse_step` finds one.

    Args:
        signals: name -> contiguous pieces of its column, each (T,).
        units: name -> unit.
    """
    found = []
    for name, pieces in signals.items():
        q = coarse_step(pieces)
        if np.isfinite(q):
            what = f"{name} is quantised in steps of {q:.3g} {units.get(name, '')}".rstrip()
            found.append(f"{what} ({_span(pieces) / q + 1:.0f} levels), coarser than its noise")
    return Check(
        "quantisation", not found, "; ".join(found) if found else "no sensor is quantised more coarsely than its noise"
    )


def coarse_step(pieces: Sequence[np.ndarray]) -> float:
    """Return the step of a sensor that is coarser than its noise; NaN: it is not.

    q > 2.5 sigma (third differences), and fewer than `FEW_LEVELS` levels.

    Args:
        pieces: contiguous rows, angles unwrapped, each (T,).
    """
    q, sigma = quantum(pieces), third_difference_std(pieces)
    coarse = np.isfinite(q) and np.isfinite(sigma) and q > COARSE * sigma and _span(pieces) < FEW_LEVELS * q
    return q if coarse else float("nan")


def _span(pieces: Sequence[np.ndarray]) -> float:
    return max((float(np.ptp(piece)) for piece in pieces if len(piece)), default=0.0)


def jitter(times: Sequence[np.ndarray], dt: float, wanted: float | None, *, as_they_are: bool = False) -> Check:
    """Find time stamps that are not equidistant.

    Args:
        times: of contiguous rows, each (T,) s.
        dt: of the data, s.
        wanted: dt to resample to, s, for the advice; None: the data are resampled anyway, which removes the jitter.
        as_they_are: every row keeps its time, so that there is nothing to do.
    """
    steps = np.concatenate([np.diff(time) for time in times]) if times else np.empty(0)
    share = irregular_share(steps, dt)
    if share == 0:
        return Check("jitter", True, "all time steps equal dt")
    low, high = np.percentile(steps, [1, 99])
    detail = (
        f"{share:.1%} of the steps differ from dt by more than 2 % (1st to 99th percentile: {low:.3g} to {high:.3g} s)"
    )
    if share <= IRREGULAR_SHARE:
        return Check("jitter", True, detail)
    if as_they_are:
        return Check("jitter", True, f"{detail}; every row keeps its time")
    cure = "resampled to equal steps" if wanted is None else f"data.resample: {wanted:.6g} makes them equal"
    return Check("jitter", wanted is None, f"{detail}; {cure}")


def irregular_share(steps: np.ndarray, dt: float) -> float:
    """Share of time steps that differ from dt by more than 2 %."""
    return float(np.mean(np.abs(steps / dt - 1) > IRREGULAR)) if len(steps) else 0.0


def held(pieces: Sequence[np.ndarray]) -> tuple[float, float]:
    """Find rows that repeat the value before them although the quantity moves before and after.

    Args:
        pieces: contiguous rows, angles unwrapped, each (T,).

    Returns:
        Their share, and the usual number of equal rows.
    """
    sizes = changes(pieces)
    if len(sizes) < FEW_RUNS:
        return 0.0, 1.0
    least = max(JUMP * float(sizes.min()), SMALL * float(np.median(sizes)))
    runs: list[np.ndarray] = []
    for piece in pieces:
        step = np.abs(np.diff(piece))
        new = np.flatnonzero(step)  # row new + 1 differs from the one before
        moving = np.minimum(step[new[:-1]], step[new[1:]]) >= least
        runs.append((np.diff(new) - 1)[moving])
    repeats = np.concatenate(runs)
    repeats = repeats[repeats > 0]
    if len(repeats) < FEW_RUNS:
        return 0.0, 1.0
    usual = float(np.median(repeats))
    short = repeats[repeats <= LONG * usual].sum()  # what lasts much longer is rest
    return float(short / sum(max(len(piece) - 1, 0) for piece in pieces)), usual + 1


def quantum(pieces: Sequence[np.ndarray]) -> float:
    """Step of which all changes of a column are whole multiples; NaN where there is none.

    Args:
        pieces: contiguous rows, angles unwrapped, each (T,).
    """
    sizes = changes(pieces)
    if len(sizes) < FEW_RUNS:
        return float("nan")
    q = float(np.quantile(sizes, 0.01, method="lower"))  # not the least: an angle that wraps makes a few odd ones
    multiples = sizes / q
    whole = np.abs(multiples - np.round(multiples)) < 0.02 * np.clip(multiples, 1.0, 10.0)
    # a ramp without noise has equal changes too, but it never pauses and never makes two at once
    stepped = len(sizes) < sum(max(len(piece) - 1, 0) for piece in pieces) or bool(np.any(multiples > 1.5))
    return q if np.mean(whole) >= GRID_SHARE and stepped else float("nan")


def changes(pieces: Sequence[np.ndarray]) -> np.ndarray:
    """Sizes of the changes from a row to the next, without zeros and what is rounding of the stored numbers."""
    sizes = np.concatenate([np.abs(np.diff(piece)) for piece in pieces]) if pieces else np.empty(0)
    size = max((float(np.max(np.abs(piece))) for piece in pieces if len(piece)), default=0.0)
    return sizes[sizes > 1e-9 * size]
