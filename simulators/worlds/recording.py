"""Which true values the sensors record in which rows: a late sensor an older one, a slow one in some rows only."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simulators.quantity import Quantity
from simulators.worlds.motion import Inputs
from simulators.worlds.sensors import Sensors
from simulators.worlds.timing import Rows


@dataclass(frozen=True)
class Recording:
    """The sensors and the rows of a data set.

    Args:
        sensors: what they make of true values.
        measured: quantities with a sensor.
        latency: quantity -> how old a value is when it is recorded, s; 0 where left out.
        rows: when rows are recorded, and who speaks in them.

    """

    sensors: Sensors
    measured: tuple[Quantity, ...]
    latency: Mapping[str, float]
    rows: Rows

    @cached_property
    def happened(self) -> dict[str, list[np.ndarray]]:
        """Return when that happened which a sensor records: per quantity and episode, s."""
        return {
            q.name: [
                np.maximum(times[speaks] - self.latency.get(q.name, 0.0), 0.0)
                for times, speaks in zip(self.rows.recorded, self.rows.speaks[q.name], strict=True)
            ]
            for q in self.measured
        }

    @cached_property
    def instants(self) -> np.ndarray:
        """Return all times (episodes, m), s, in order, at which true values are asked for."""
        return _padded([np.unique(np.concatenate(each)) for each in zip(*self.happened.values(), strict=True)])

    def read(self, true: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return one value per row of every sensor, NaN where it does not speak.

        Args:
            true: name -> true values (episodes, m) at the instants.

        """
        return {q.name: np.concatenate([*self._episodes(q, true)]) for q in self.measured}

    def _episodes(self, quantity: Quantity, true: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        found = []
        for k, times in enumerate(self.rows.recorded):
            at = np.searchsorted(self.instants[k], self.happened[quantity.name][k])
            values = np.full(len(times), np.nan)
            here = {name: each[k, at] for name, each in true.items()}
            values[self.rows.speaks[quantity.name][k]] = self.sensors.read(quantity, here, k)
            found.append(values)
        return found

    def given(self, names: list[str], inputs: Inputs, tie: float) -> dict[str, np.ndarray]:
        """Return the inputs, one value per row each; a row of another sensor has what the plant sees then."""
        values = inputs.at(_padded(self.rows.recorded), tie)
        each = [values[k, : len(times)] for k, times in enumerate(self.rows.recorded)]
        return {name: np.concatenate(each)[:, i] for i, name in enumerate(names)}


def _padded(each: list[np.ndarray]) -> np.ndarray:
    """Return rows of different lengths as one array; the shorter ones repeat their last value."""
    longest = max(map(len, each))
    return np.array([np.pad(row, (0, longest - len(row)), mode="edge") for row in each])
