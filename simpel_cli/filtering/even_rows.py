"""Rows whose time stamps stray, moved to even ones: a transition takes one step of the simulator, whatever its stamps say.

    g_k = a + b k, the line through the stamps,    y_k = y(t_k) + S(g_k) - S(t_k)
    S(t_j + e) = F(x_j, e) + e/h (x_{j+1} - F(x_j, h)),    h = t_{j+1} - t_j

F is the flow of the simulator from the smoothed state x_j; what it lacks until the next stamp is shared out. A held input is
its mean over the even step, which gives a change the input that it had; a linear one is read off at the even row.
"""

from collections.abc import Callable, Sequence

import numpy as np

from simpel_cli.data.checks.sensors import IRREGULAR_SHARE, irregular_share
from simpel_cli.data.recording import Episode
from simpel_cli.filtering.measurements.windows import strays

FEWEST = 2  # rows that a line is laid through
LONG = 30  # rows that tell the step of their own clock; from fewer, stamps that stray tell it worse than all episodes together
SUBSTEPS = 4  # of Runge and Kutta between two stamps

Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of states (T, nx) and inputs (T, nu), in order, (T, nx)


def uneven(episodes: Sequence[Episode], dt: float) -> bool:
    """Whether stamps of rows that follow each other stray, as the check `jitter` has it; dt: of the simulator, s.

    Rows of an even clock whose stamps are rounded are even already: by their stamps they would be moved away from there.
    """
    if any(e.next_states is not None for e in episodes):
        return False
    steps = np.concatenate([np.diff(e.time) for e in episodes])
    if not strays(steps, dt):
        return False
    usual = float(np.median(steps))
    return abs(usual / dt - 1) < 0.5 and irregular_share(steps, usual) > IRREGULAR_SHARE


def even_times(times: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the lines through the stamps of episodes, each (T,) s; a clock that is a little fast or slow stays so."""
    rows = [np.arange(len(t)) - (len(t) - 1) / 2 for t in times]
    common = sum(float(r @ t) for r, t in zip(rows, times, strict=True)) / sum(float(r @ r) for r in rows)
    return [
        t.mean() + r * (float(r @ t) / float(r @ r) if len(t) >= LONG else common)
        for r, t in zip(rows, times, strict=True)
    ]


def moved(
    time: np.ndarray, to: np.ndarray, smoothed: np.ndarray, inputs: np.ndarray, linear: Sequence[int], rates: Rates
) -> np.ndarray:
    """Return by how much states move from their stamps to other times, (T, nx).

    Args:
        time: stamps, (T,) s.
        to: other times, (T,) s.
        smoothed: states at the stamps, (T, nx); NaN where nothing is known, which do not move.
        inputs: at the stamps, (T, nu).
        linear: inputs that go straight from stamp to stamp; the others are held.
        rates: of the simulator.
    """
    if len(time) < FEWEST:
        return np.zeros(smoothed.shape)
    j = np.clip(np.searchsorted(time, to, side="right") - 1, 0, len(time) - 1)
    following = np.minimum(j + 1, len(time) - 1)  # behind the last stamp there is none: the flow goes on, inputs stay
    begin, end, after = smoothed[j], smoothed[following], to - time[j]
    whole = np.where(following > j, time[following] - time[j], np.inf)
    straight = np.isin(np.arange(inputs.shape[1]), list(linear))
    slope = np.where(straight, (inputs[following] - inputs[j]) / whole[:, None], 0.0)

    def flow(length: np.ndarray) -> np.ndarray:
        x, h = begin, (length / SUBSTEPS)[:, None]
        for k in range(SUBSTEPS):
            u = [inputs[j] + slope * (k + part) * h for part in (0.0, 0.5, 1.0)]
            a = rates(x, u[0])
            b = rates(x + h / 2 * a, u[1])
            c = rates(x + h / 2 * b, u[1])
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, u[2]))
        return x

    lacking = (np.clip(after / whole, 0, 1))[:, None] * (end - flow(np.where(following > j, whole, 0.0)))
    shift = flow(after) + lacking - smoothed
    return np.where(np.isfinite(shift), shift, 0.0)


def inputs_at(time: np.ndarray, to: np.ndarray, inputs: np.ndarray, linear: Sequence[int]) -> np.ndarray:
    """Return the inputs of even rows, (T, nu).

    Args:
        time: stamps, (T,) s.
        to: even rows, (T,) s.
        inputs: at the stamps, (T, nu).
        linear: which go straight from stamp to stamp; the others are held.
    """
    if len(time) < FEWEST:
        return inputs
    found = np.empty(inputs.shape)
    ends = np.append(to, 2 * to[-1] - to[-2])
    for j in range(inputs.shape[1]):
        if j in linear:
            found[:, j] = np.interp(to, time, inputs[:, j])
            continue
        # the integral of a held input is straight between stamps; before the first and behind the last it goes on
        stamps = np.concatenate([[min(time[0], ends[0]) - 1.0], time, [max(time[-1], ends[-1]) + 1.0]])
        held = np.append(inputs[0, j], inputs[:, j])
        whole = np.append(0.0, np.cumsum(held * np.diff(stamps)))
        found[:, j] = np.diff(np.interp(ends, stamps, whole)) / np.diff(ends)
    return found
