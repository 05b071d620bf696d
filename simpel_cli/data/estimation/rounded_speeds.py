"""Whether a velocity was computed from a position, where the numbers that were stored of both were rounded.

Nothing is exact then, and weights that are free fit what rounding has left of the noise. So the filter is a known one, a
difference behind a first-order filter with DC gain 1,

    v[k] = a v[k-1] + (1 - a) (difference of p at k) + e[k],

and what rounding to steps of q_p and q_v alone makes of e is known: with d[j] the weights of the difference, 1/s,

    var e = (1 + a^2) q_v^2/12 + (1 - a)^2 sum d^2 q_p^2/12.

A velocity of its own sensor misses it by the position's noise before it was rounded, too, which the computed one has inside.
Errors of rounding are those only where a value moves from step to step by its noise; a velocity that stands on its steps may
miss the filter by less. So the position's noise has to be found in it, too: fourth differences of both sides go together row by
row, by four standard deviations of what they do when shifted.

Reference: Widrow, Kollar and Liu (1996), Statistical theory of quantization.
"""

import numpy as np

from simpel_cli.data.checks.noise import runs
from simpel_cli.data.checks.rounding import rounding
from simpel_cli.data.estimation.kinematics import Motion
from simpel_cli.data.estimation.position_noise import FAR, WHITE, on_grid, white_level

DIFFERENCES = {  # rows from k -> weights, per row
    "central": {-1: -0.5, 1: 0.5},
    "backward": {-1: -1.0, 0: 1.0},
    "forward": {0: -1.0, 1: 1.0},
}
POLES = np.linspace(0.0, 0.95, 96)  # a: to a time constant of 20 rows
OF_NOISE = 0.35  # of the variance with which the position's noise would be in e, which is all there of another sensor
TELLING = 0.5  # of the variance of rounding: less noise than that, and rounding hides it
SCATTERED = 0.6  # the same of the position itself: errors of coarser steps follow the motion
LAGS = range(12, 52)  # rows, either way, at which white noise has nothing in common
ABOVE = 4.0  # standard deviations of the correlations at these
FEW_ROWS = 100  # with which a variance is known to 15 %


def rounded_kind(motion: Motion) -> str | None:
    """Say of which difference quotient the velocity was made before it was rounded: central, ...; None: of none."""
    pieces = [on_grid(*piece) for piece in motion.pieces if len(piece[0]) > 1]
    steps = [rounding([run for piece in pieces for run in runs(piece[i])]) for i in (0, 1)]
    if not pieces or not np.all(np.isfinite(steps)):
        return None
    centre = np.nanmean(np.concatenate([p for p, _ in pieces]))
    positions = [p - centre for p, _ in pieces]
    # sizes of differences of what was rounded are few different numbers, so that their median jumps
    levels = [white_level(positions, order, mean=True) for order in (4, 8)]
    if not WHITE * levels[0] < levels[1] < levels[0] / WHITE:
        return None
    by_rounding = [step**2 / 12 for step in steps]
    own = levels[0] ** 2 - by_rounding[0]
    if own < SCATTERED * by_rounding[0]:
        return None
    dt = float(np.median(np.concatenate([np.diff(t) for t, _, _ in motion.pieces])))
    found = {kind: _left(weights, pieces, dt, by_rounding, own) for kind, weights in DIFFERENCES.items()}
    kind = min(found, key=lambda name: found[name][0])
    left, pole = found[kind]
    made = -OF_NOISE < left < OF_NOISE and _go_together(DIFFERENCES[kind], pieces, pole)
    return f"{kind} (filtered and rounded)" if made else None


def _go_together(weights: dict[int, float], pieces: list[tuple[np.ndarray, np.ndarray]], pole: float) -> bool:
    """Whether the noise of both sides of the filter's equation is the same, row by row."""
    both = []
    for p, v in pieces:
        own, slope = _sides(weights, p, v, pole)
        rows = np.full((2, max(len(own) - 4, 0) + max(LAGS) + 1), np.nan)  # no piece reaches the next one
        rows[:, : max(len(own) - 4, 0)] = np.diff(own, 4), np.diff(slope, 4)
        both.append(rows)
    own, slope = np.concatenate(both, axis=1)

    def correlation(lag: int) -> float:
        """Return the correlation in standard deviations of one of as many independent numbers."""
        x, y = own[max(lag, 0) : len(own) + min(lag, 0)], slope[max(-lag, 0) : len(own) + min(-lag, 0)]
        there = np.isfinite(x) & np.isfinite(y)
        size = np.sqrt(np.sum(x[there] ** 2) * np.sum(y[there] ** 2))
        return float(x[there] @ y[there] / size * np.sqrt(np.sum(there))) if size > 0 else 0.0

    others = [correlation(way * lag) for lag in LAGS for way in (-1, 1)]
    return correlation(0) > ABOVE * float(np.sqrt(np.mean(np.square(others))))


def _sides(weights: dict[int, float], p: np.ndarray, v: np.ndarray, pole: float) -> tuple[np.ndarray, np.ndarray]:
    """Return v[k] - a v[k-1] and the difference of p, per row, at the rows where both are defined."""
    k = np.arange(1, max(len(p) - 1, 1))
    return v[k] - pole * v[k - 1], sum((w * p[k + j] for j, w in weights.items()), np.zeros(len(k)))


def _left(
    weights: dict[int, float], pieces: list[tuple[np.ndarray, np.ndarray]], dt: float, rounded: list[float], own: float
) -> tuple[float, float]:
    """Return what a filter leaves beyond the errors of rounding, over what the position's own noise makes of it, and its pole.

    Args:
        weights: of the difference, by rows from k, per row.
        pieces: (position, velocity) in equal steps, NaN where there is none.
        dt: s.
        rounded: variances of the errors of rounding.
        own: variance of the position's noise before.
    """
    gain = sum(w**2 for w in weights.values()) / dt**2
    least, best = np.inf, 0.0
    for a in POLES.tolist():
        sides = [_sides(weights, p, v, a) for p, v in pieces]
        missed = np.concatenate([np.abs(seen - (1 - a) * slope / dt) for seen, slope in sides])
        missed = missed[np.isfinite(missed)]
        by_rounding = (1 + a**2) * rounded[1] + (1 - a) ** 2 * gain * rounded[0]
        passed = (1 - a) ** 2 * gain * own
        if len(missed) < FEW_ROWS or passed <= TELLING * by_rounding:
            continue
        near = missed[missed <= FAR * np.median(missed)]
        left = (float(np.mean(near**2)) - by_rounding) / passed
        least, best = (left, a) if left < least else (least, best)
    return least, best
