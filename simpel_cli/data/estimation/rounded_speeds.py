"""Whether a velocity was computed from a position, where the numbers that were stored of both were rounded.

Nothing is exact then, and weights that are free fit what rounding has left of the noise. So the filter is a known one, a
difference behind a first-order filter with DC gain 1,

    v[k] = a v[k-1] + (1 - a) (difference of p at k) + e[k],

and what rounding to steps of q_p and q_v alone makes of e is known: with d[j] the weights of the difference, 1/s,

    var e = (1 + a^2) q_v^2/12 + (1 - a)^2 sum d^2 q_p^2/12.

A velocity of its own sensor misses it by the position's noise before it was rounded, too, which the computed one has inside.

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
SCATTERED = 0.9  # the same of the position itself: errors of coarser steps follow the motion
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
    kind = min(found, key=lambda name: found[name])
    return f"{kind} (filtered and rounded)" if found[kind] < OF_NOISE else None


def _left(
    weights: dict[int, float], pieces: list[tuple[np.ndarray, np.ndarray]], dt: float, rounded: list[float], own: float
) -> float:
    """Return what a filter leaves beyond the errors of rounding, over what the position's own noise makes of it; the least.

    Args:
        weights: of the difference, by rows from k, per row.
        pieces: (position, velocity) in equal steps, NaN where there is none.
        dt: s.
        rounded: variances of the errors of rounding.
        own: variance of the position's noise before.
    """
    targets, before, slopes = [], [], []
    for p, v in pieces:
        k = np.arange(1, len(p) - 1)
        targets.append(v[k])
        before.append(v[k - 1])
        slopes.append(sum((w * p[k + j] for j, w in weights.items()), np.zeros(len(k))) / dt)
    target, last, slope = (np.concatenate(each) for each in (targets, before, slopes))
    there = np.isfinite(target) & np.isfinite(last) & np.isfinite(slope)
    if np.sum(there) < FEW_ROWS:
        return np.inf
    gain = sum(w**2 for w in weights.values()) / dt**2
    least = np.inf
    for a in POLES:
        missed = np.abs(target - a * last - (1 - a) * slope)[there]
        near = missed[missed <= FAR * np.median(missed)]
        by_rounding = (1 + a**2) * rounded[1] + (1 - a) ** 2 * gain * rounded[0]
        passed = (1 - a) ** 2 * gain * own
        if passed > TELLING * by_rounding:
            least = min(least, (float(np.mean(near**2)) - by_rounding) / passed)
    return least
