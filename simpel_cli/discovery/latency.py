"""How old a reading is when it is recorded, where the data give a range for it.

The calibrated simulator is asked at latencies across the range, then nearer and nearer to the best. Its evidence is compared on
the same readings: those of the first moments, which a longer latency would place before the record, are left out throughout.
Several latencies are estimated in turn, until none moves.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Episode, Recording

COARSE = 12  # intervals of a range, at most; half a row each if that is fewer
ROUNDS = 4  # of halving the distance to the neighbours of the best
TURNS = 3  # through all latencies
QUANTILE = 1.645  # of the normal law, for an interval of 90 %
TIE = 1e-6  # of a row


class Latency(NamedTuple):
    """What the data say of one latency.

    Args:
        value: s.
        low, high: 90 % interval, s.
        gain: nats of evidence by which it is ahead of the worst one in the range.
        at_end: whether it lies at an end of its range, beyond which it may go on.
    """

    value: float
    low: float
    high: float
    gain: float
    at_end: bool


def estimated(
    evidence: Callable[[Mapping[str, float]], float], ranges: Mapping[str, tuple[float, float]], dt: float
) -> dict[str, Latency]:
    """Return every latency that was given by a range.

    Args:
        evidence: latencies, s -> log evidence of the calibrated simulator.
        ranges: s.
        dt: distance of the rows, s.
    """
    at = {name: (low + high) / 2 for name, (low, high) in ranges.items()}
    found: dict[str, Latency] = {}
    for _ in range(TURNS if len(ranges) > 1 else 1):
        before = dict(at)
        for name, ends in ranges.items():
            found[name] = _along(lambda s, name=name: evidence(at | {name: s}), ends, dt)  # type: ignore[misc]
            at[name] = found[name].value
        if all(abs(at[name] - before[name]) < 0.01 * dt for name in at):
            break
    return found


def _along(evidence: Callable[[float], float], ends: tuple[float, float], dt: float) -> Latency:
    low, high = ends
    count = int(min(COARSE, max(2, np.ceil((high - low) / (dt / 2)))))
    tried = {float(s): evidence(float(s)) for s in np.linspace(low, high, count + 1)}
    step = (high - low) / count
    for _ in range(ROUNDS):
        centre = max(tried, key=lambda t: tried[t])
        step /= 2
        for near in (centre - step, centre + step):
            if low <= near <= high and not any(abs(near - t) < step / 10 for t in tried):
                tried[near] = evidence(near)
    s = np.array(sorted(tried))
    values = np.array([tried[t] for t in s])
    k = int(np.argmax(values))
    at_end = k in (0, len(s) - 1)
    best, sd = float(s[k]), step
    around = slice(max(k - 2, 0), k + 3)
    curve = np.polyfit(s[around] - best, values[around], 2) if np.isfinite(values[around]).all() else np.zeros(3)
    if curve[0] < 0:
        sd = float(np.sqrt(-0.5 / curve[0]))
        if not at_end:
            best = float(np.clip(best - curve[1] / (2 * curve[0]), s[k - 1], s[k + 1]))
    reach = QUANTILE * sd
    worst = values[np.isfinite(values)].min() if np.isfinite(values).any() else np.nan
    return Latency(best, max(best - reach, low), min(best + reach, high), float(values[k] - worst), at_end)


def same_readings(
    recording: Recording,
    columns: Mapping[str, int],
    latency: Mapping[str, float],
    longest: Mapping[str, float],
    dt: float,
) -> Recording:
    """Leave out what was recorded so early that the longest latency would place it before the record.

    Args:
        recording: read with `latency`.
        columns: quantity -> its column among states and outputs.
        latency: s.
        longest: end of its range, s.
        dt: distance of the rows, s.
    """

    def kept(episode: Episode) -> Episode:
        states, outputs = episode.states.copy(), episode.outputs.copy()
        for name, j in columns.items():
            late = 0.0 if episode.late is None else episode.late[:, j]
            stamp = episode.time - late + latency[name]
            early = stamp < episode.time[0] + longest[name] - TIE * dt
            target, i = (states, j) if j < states.shape[1] else (outputs, j - states.shape[1])
            target[early, i] = np.nan
        return episode._replace(states=states, outputs=outputs)

    return recording._replace(train=tuple(map(kept, recording.train)), test=tuple(map(kept, recording.test)))


def in_words(found: Mapping[str, Latency]) -> str:
    """Return what was found in a line."""
    return "; ".join(
        f"{name} {each.value:.3g} s ({each.low:.3g} to {each.high:.3g})"
        + (", at the end of its range: give a wider one" if each.at_end else "")
        for name, each in found.items()
    )


def sentence_of(found: Mapping[str, Latency]) -> str:
    """Return what a verdict says of them."""
    said = [
        f"{name} is recorded {each.value:.3g} s late ({each.low:.3g} to {each.high:.3g} s)"
        for name, each in found.items()
    ]
    return f" {'; '.join(said)}." if said else ""
