"""When rows are recorded, and in which of them each sensor speaks.

The motion begins at t = 0. Where a sensor is late, the rows begin later by its latency, so that what it recorded in the
first of them has happened. A sensor with a clock of its own speaks at its own times, which become rows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from simulators.model import TIE, ModelError
from simulators.worlds.streams import Streams

MOST_JITTER = 0.5  # of dt: rows stay in order


@dataclass(frozen=True)
class Clock:
    """A sensor's own clock: its m-th sample is at offset + m period (1 + drift).

    Args:
        offset: s, when it samples first, counted from the beginning of the motion.
        drift: how much slower it goes than the true time, relative; above -1.

    """

    offset: float = 0.0
    drift: float = 0.0


class Rows(NamedTuple):
    """The rows of a data set.

    Args:
        inputs: (episodes, n) times at which the inputs are given, s, from the beginning of the motion.
        recorded: per episode, times of the recorded rows, s.
        speaks: quantity -> per episode, the recorded rows in which its sensor speaks.

    """

    inputs: np.ndarray
    recorded: list[np.ndarray]
    speaks: dict[str, list[np.ndarray]]


@dataclass(frozen=True)
class Timing:
    """When things happen; the fields are those of `Simulate`.

    Args:
        latency: quantity -> how old a value is when it is recorded, s.
        rates: quantity -> s between two samples of its sensor.
        clocks: quantity -> its sensor's own clock.
        jitter: share of dt by which the times of rows vary at random, at most 0.5.

    """

    latency: Mapping[str, float] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    jitter: float = 0.0

    def check(self) -> None:
        """Refuse values that are not allowed."""
        for name, late in self.latency.items():
            if not 0 <= late < math.inf:
                raise ModelError(f"simulation.latency.{name}: {late:g} s is not allowed; give 0 s or more")
        for name, period in self.rates.items():
            if not 0 < period < math.inf:
                raise ModelError(f"simulation.rates.{name}: {period:g} s is not allowed; give more than 0 s")
        for name, clock in self.clocks.items():
            if not math.isfinite(clock.offset) or not -1 < clock.drift < math.inf:
                raise ModelError(
                    f"simulation.clocks.{name}: offset = {clock.offset:g} s, drift = {clock.drift:g} is not allowed; give a "
                    "finite offset, and a drift above -1"
                )
        if not 0 <= self.jitter < MOST_JITTER:
            raise ModelError(
                f"simulation.jitter: {self.jitter:g} is not allowed; give 0 <= share < {MOST_JITTER:g}; rows stay in order"
            )

    def planted(self, measured: list[str]) -> dict[str, Any]:
        """Return what the card says: what is planted about the time of measured quantities."""
        card: dict[str, Any] = {
            "latency": {name: late for name, late in self.latency.items() if name in measured},
            "rates": {name: period for name, period in self.rates.items() if name in measured},
            "clocks": {
                name: {"offset": clock.offset, "drift": clock.drift}
                for name, clock in self.clocks.items()
                if name in measured
            },
            "jitter": self.jitter,
        }
        return {key: value for key, value in card.items() if value}

    def lead(self, measured: list[str], dt: float) -> int:
        """Return how many rows pass before the first that is recorded."""
        late = max((self.latency.get(name, 0.0) for name in measured), default=0.0)
        return math.ceil(late / dt + self.jitter - TIE) if late else 0

    def rows(self, measured: list[str], dt: float, episodes: int, steps: int, streams: Streams) -> Rows:
        """Return the rows of `steps` recorded instants of the inputs, `dt` apart but for their jitter, per episode."""
        lead = self.lead(measured, dt)
        times = np.tile(dt * np.arange(lead + steps), (episodes, 1))
        if self.jitter:
            for k in range(episodes):  # the motion begins in the first one
                times[k, 1:] += dt * self.jitter * streams.of("jitter", k).uniform(-1, 1, lead + steps)[1:]
        every = {name: self._every(name, dt) for name in measured if name not in self.clocks}
        recorded: list[np.ndarray] = []
        speaks: dict[str, list[np.ndarray]] = {name: [] for name in measured}
        for own in times:
            samples = {name: self._samples(name, dt, own[lead], own[-1]) for name in self.clocks if name in measured}
            union = _union([own[lead:], *samples.values()], TIE * dt)
            recorded.append(union)
            for name in measured:
                at = own[lead:][(lead + np.arange(steps)) % every[name] == 0] if name in every else samples[name]
                if not len(at):
                    raise ModelError(
                        f"simulation.rates.{name}: no sample in {steps} rows of {dt:g} s; give more steps, or a shorter period"
                    )
                speaks[name].append(_nearest(union, at))
        return Rows(times, recorded, speaks)

    def _every(self, name: str, dt: float) -> int:
        """Return in every how many rows a sensor without a clock of its own speaks."""
        period = self.rates.get(name, dt)
        every = round(period / dt)
        if every < 1 or abs(period / dt - every) > 1e-6:
            raise ModelError(
                f"simulation.rates.{name}: {period:g} s is no whole number of rows of {dt:g} s; change it, or give the sensor "
                f"a clock of its own: simulation.clocks.{name}={{offset: 0}}"
            )
        return every

    def _samples(self, name: str, dt: float, first: float, last: float) -> np.ndarray:
        """Return the times at which a sensor with its own clock speaks, within those of the rows."""
        clock = self.clocks[name]
        period = self.rates.get(name, dt) * (1 + clock.drift)
        begin = max(math.ceil((first - clock.offset) / period - TIE), 0)
        end = math.floor((last - clock.offset) / period + TIE)
        if end < begin:
            raise ModelError(
                f"simulation.clocks.{name}: no sample between the first row, {first:g} s, and the last, {last:g} s; give more "
                "steps, or a smaller offset"
            )
        return np.clip(clock.offset + period * np.arange(begin, end + 1), first, last)


def _union(times: list[np.ndarray], tie: float) -> np.ndarray:
    """Return all times in order, those that agree within `tie` once, as the earliest list has them."""
    found = times[0]
    for more in times[1:]:
        new = more[np.abs(found[_nearest(found, more)] - more) > tie]
        found = np.sort(np.concatenate([found, new]))
    return found


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return which of the times (in order) is nearest to each wanted one."""
    right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(times[left] - wanted) <= np.abs(times[right] - wanted), left, right)
