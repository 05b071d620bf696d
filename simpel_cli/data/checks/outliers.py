"""Single values of a sensor that stand out from their neighbours, found without a model.

    d[k] = y[k] - (-y[k-2] + 4 y[k-1] + 4 y[k+1] - y[k+2])/6        (zero on any cubic)
    l[k] = y[k] - polynomial through the rows before k,    r[k] the same through the rows after k

A value is left out if |d| is far beyond what is usual for the channel, and neither the rows before it nor those after it
lead there. A jump, an impact, a stop or a switched input has two sides, and each of its values belongs to one of them.
Values that a spike of an input may have caused are not tested. Where the scale s[k] of the noise goes with the row, d[k] is
compared with what is usual for the noise that it has,

    (s[k]^2 + (s[k-2]^2 + 16 s[k-1]^2 + 16 s[k+1]^2 + s[k+2]^2)/36)/(70/36),    1 where s is 1

Reference: Hampel (1974), The influence curve and its role in robust estimation (median absolute deviation).
"""

from collections.abc import Sequence

import numpy as np

from simpel_cli.data.checks.sensors import quantum

FAR = 6.0  # usual deviations
ROBUST = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
SHARE = (0.5, 1.6)  # of d: what l and r of a lone value are, with noise
TRUST = 2.0  # times what the same polynomial missed the two rows before by
PASSES = 5  # one value can hide another one beside it
EXTRAPOLATE = {1: (2.0, -1.0), 2: (3.0, -3.0, 1.0), 3: (4.0, -6.0, 4.0, -1.0)}  # weights of the nearest row first
KICK = 0.2  # of the span of an input: a smaller change is no spike


def lone_values(
    pieces: Sequence[np.ndarray], inputs: Sequence[np.ndarray], scales: Sequence[np.ndarray] | None = None
) -> list[np.ndarray]:
    """Find values of one channel that stand alone.

    Args:
        pieces: contiguous rows at equal steps, angles unwrapped, each (T,).
        inputs: of the same rows, held from a row to the next, each (T, nu).
        scales: of the noise of every value over the typical one, each (T,); None: it is the same in every row.

    Returns:
        A mask (T,) per piece.
    """
    pieces = [np.array(piece, float) for piece in pieces]
    blind = _after_kicks(inputs)
    found = [np.zeros(len(piece), bool) for piece in pieces]
    if not pieces:
        return found
    step = quantum(pieces)
    loud = [np.ones(len(piece)) for piece in pieces] if scales is None else [_of_middle(scale) for scale in scales]
    for _ in range(PASSES):
        news = _one_pass(pieces, blind, loud, 0.0 if np.isnan(step) else step)
        if not any(new.any() for new in news):
            break
        for piece, mask, new in zip(pieces, found, news, strict=True):
            piece[new] -= _middle(piece)[new]
            mask |= new
    return found


def _one_pass(
    pieces: Sequence[np.ndarray], blind: Sequence[np.ndarray], loud: Sequence[np.ndarray], step: float
) -> list[np.ndarray]:
    middle = [_middle(piece) for piece in pieces]
    usual = max(_usual([d / own for d, own in zip(middle, loud, strict=True)]), step)
    sides = {m: [(_side(p, w), _side(p[::-1], w)[::-1]) for p in pieces] for m, w in EXTRAPOLATE.items()}
    # noise asks for a low order, a fast motion for a high one
    order = min(sides, key=lambda m: _usual([left for left, _ in sides[m]]))
    if not usual > 0:
        return [np.zeros(len(p), bool) for p in pieces]
    return [
        (np.abs(d) > FAR * np.maximum(usual * own, step))
        & ~unseen
        & _leads_elsewhere(left, d)
        & _leads_elsewhere(right[::-1], d[::-1])[::-1]
        for d, (left, right), unseen, own in zip(middle, sides[order], blind, loud, strict=True)
    ]


def _middle(y: np.ndarray) -> np.ndarray:
    """Distance of every value from the cubic through its four neighbours; 0 at the ends."""
    d = np.zeros(len(y))
    if len(y) > 4:
        d[2:-2] = y[2:-2] - (-y[:-4] + 4 * y[1:-3] + 4 * y[3:-1] - y[4:]) / 6
    return d


def _of_middle(scale: np.ndarray) -> np.ndarray:
    """Scale of what `_middle` has of noise, over that of noise of scale 1; at the ends, where it is 0, 1."""
    found, square = np.ones(len(scale)), scale**2
    if len(scale) > 4:
        around = square[:-4] + 16 * square[1:-3] + 16 * square[3:-1] + square[4:]
        found[2:-2] = np.sqrt((square[2:-2] + around / 36) / (70 / 36))
    return found


def _side(y: np.ndarray, weights: Sequence[float]) -> np.ndarray:
    """Distance of every value from the polynomial through the rows before it; NaN where there are too few."""
    m = len(weights)
    out = np.full(len(y), np.nan)
    if len(y) > m:
        out[m:] = y[m:] - sum(w * y[m - 1 - j : len(y) - 1 - j] for j, w in enumerate(weights))
    return out


def _leads_elsewhere(side: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Whether the rows before miss a value as a lone one is missed, and did not miss those before it alike."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = side / d
    before = np.full((2, len(side)), np.nan)
    before[0, 1:], before[1, 2:] = side[:-1], side[:-2]
    missed = np.max(np.abs(np.nan_to_num(before, nan=np.inf)), axis=0)
    return np.asarray((share > SHARE[0]) & (share < SHARE[1]) & (np.abs(side) > TRUST * missed))


def _usual(signals: Sequence[np.ndarray]) -> float:
    values = np.concatenate(signals)
    values = np.abs(values[np.isfinite(values)])
    return ROBUST * float(np.median(values)) if len(values) else np.inf


def _after_kicks(inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Rows up to two behind a row in which an input alone stands out: a fast state may have followed it."""
    spans = np.ptp(np.concatenate(inputs), axis=0) if inputs else np.zeros(0)
    blind = []
    for u in inputs:
        kicked = np.zeros(len(u), bool)
        if len(u) > 2 and u.shape[1]:
            rise, fall = u[1:-1] - u[:-2], u[1:-1] - u[2:]
            alone = np.minimum(np.abs(rise), np.abs(fall)) > np.maximum(2 * np.abs(rise - fall), KICK * spans)
            kicked[1:-1] = np.any(alone & (rise * fall > 0), axis=1)
        late = np.zeros(len(u), bool)
        late[1:] |= kicked[:-1]
        late[2:] |= kicked[:-2]
        blind.append(late)
    return blind
