"""Bring episodes to another dt without aliasing.

What swings faster than half the new rate would appear as a slow motion that is not there. So states and outputs pass
a zero-phase low-pass filter (windowed sinc, 60 dB) first, then every k-th row is kept, or a cubic spline is read where
k is not whole. Of an input that is held between rows it is the mean over the new interval, which keeps the impulse; one that
is linear passes the same filter as the states, so that a linear system stays as it is.

Reference: Oppenheim and Schafer, Discrete-Time Signal Processing (Kaiser window design, 2010, section 7.5).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Check, Episode

HALF_WIDTH = 4  # new rows that the filter reaches to either side
CUTOFF = 0.7  # of the new Nyquist frequency: flat to 0.25, 60 dB down from 1.15, so that aliases stay above 0.85
ATTENUATION = 60.0  # dB
UNIFORM = 0.05  # of a step: times that stray less count as equidistant


class Resampled(NamedTuple):
    """Episodes at the new dt."""

    episodes: tuple[Episode, ...]
    noise_gain: float  # factor by which the filter shrinks the standard deviation of white noise
    check: Check


def resample(episodes: tuple[Episode, ...], raw: float, dt: float, linear: Sequence[int] = ()) -> Resampled:
    """Bring every episode to `dt`.

    The filter sees measured rows only: where it would reach past an end, rows are dropped (`HALF_WIDTH` at either end).

    Args:
        episodes: contiguous rows about `raw` apart, angles unwrapped.
        raw: dt of the data, s.
        dt: wanted, s.
        linear: inputs that go straight from a row to the next; the others are held.

    Returns:
        The episodes with at least two rows, in order, and what was done.
    """
    # a filter longer than every episode leaves nothing, however long: it need not be built in full
    taps = lowpass(min(dt / raw, max((len(episode.time) for episode in episodes), default=1)))
    brought = tuple(_one(episode, raw, dt, taps, list(linear)) for episode in episodes)
    kept = tuple(episode for episode in brought if len(episode.time) > 1)
    lost = len(brought) - len(kept)
    if len(taps) == 1:
        done = f"{raw:.4g} -> {dt:.4g} s by cubic interpolation"
    else:
        how = "every k-th row" if _whole(dt / raw) else "cubic interpolation"
        done = (
            f"{raw:.4g} -> {dt:.4g} s: zero-phase low-pass at {CUTOFF * 0.5 / dt:.3g} Hz, then {how}; inputs averaged; "
            f"{HALF_WIDTH} rows dropped at either end of an episode"
        )
    if lost:
        done += f"; {lost} of {len(brought)} segments are too short for it and were dropped"
    return Resampled(kept, float(np.sqrt(np.sum(taps**2))), Check("resample", lost == 0, done))


def lowpass(ratio: float) -> np.ndarray:
    """Symmetric filter, shape (odd,), that sums to one; a single 1 where the rate does not fall.

    Args:
        ratio: new dt over old dt.
    """
    if ratio < 1.001:
        return np.ones(1)
    from scipy.signal import firwin, kaiser_beta  # here, since its import takes long and most data need no filter

    half = int(np.ceil(HALF_WIDTH * ratio))
    return np.asarray(firwin(2 * half + 1, CUTOFF / ratio, window=("kaiser", kaiser_beta(ATTENUATION))), dtype=float)


def _one(episode: Episode, raw: float, dt: float, taps: np.ndarray, linear: list[int]) -> Episode:
    n_states, n_outputs = episode.states.shape[1], episode.outputs.shape[1]
    time, values = _equidistant(
        episode.time, np.concatenate([episode.states, episode.outputs, episode.inputs[:, linear]], axis=1), raw
    )
    if len(time) <= len(taps):  # less than two rows would be left
        return Episode(episode.name, *(column[:0] for column in episode[1:5]))
    half = len(taps) // 2
    if half:
        from scipy.signal import oaconvolve

        values = oaconvolve(values, taps[:, None], mode="valid", axes=0)
        time = time[half:-half]
    if _whole(dt / raw):
        step = round(dt / raw)
        time, values = time[::step], values[::step]
    else:
        grid = time[0] + dt * np.arange(int((time[-1] - time[0]) / dt * (1 + 1e-9) + 1e-6) + 1)
        time, values = grid, _spline(time, values, grid)
    inputs = _interval_means(episode.time, episode.inputs, time, dt, raw)
    inputs[:, linear] = values[:, n_states + n_outputs :]
    return Episode(episode.name, time, values[:, :n_states], inputs, values[:, n_states : n_states + n_outputs])


def _whole(ratio: float) -> bool:
    """Whether a row of the old grid falls on every row of the new one: 1e-4 is a tenth of a row in 1000."""
    return ratio > 0.5 and abs(ratio / round(ratio) - 1) < 1e-4


def _equidistant(time: np.ndarray, values: np.ndarray, raw: float) -> tuple[np.ndarray, np.ndarray]:
    """Read a spline at equal steps of `raw` where the times stray from them."""
    grid = time[0] + raw * np.arange(int((time[-1] - time[0]) / raw + UNIFORM) + 1)
    if len(grid) == len(time) and np.max(np.abs(grid - time)) <= UNIFORM * raw:
        return grid, values
    return grid, _spline(time, values, grid)


def _spline(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(time, values, axis=0)(at))


def _interval_means(time: np.ndarray, inputs: np.ndarray, start: np.ndarray, dt: float, raw: float) -> np.ndarray:
    """Mean of held inputs over [start, start + dt); the last sample is held on.

    Args:
        time: of the samples, (T,) s.
        inputs: held from each sample to the next, (T, n_inputs).
        start: of the intervals, (K,) s.
        dt: length of an interval, s.
        raw: time for which the last sample counts at least, s.
    """
    edges = np.append(time, max(time[-1], start[-1] + dt) + raw)
    area = np.concatenate([np.zeros((1, inputs.shape[1])), np.cumsum(inputs * np.diff(edges)[:, None], axis=0)])
    means = [(np.interp(start + dt, edges, a) - np.interp(start, edges, a)) / dt for a in area.T]
    return np.stack(means, axis=1) if means else np.empty((len(start), 0))
