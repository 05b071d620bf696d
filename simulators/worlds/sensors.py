"""What sensors make of the true values: noise, and angles that are wrapped."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simulators.quantity import Quantity
from simulators.worlds.streams import Streams


def wrapped(quantity: Quantity, values: np.ndarray) -> np.ndarray:
    """Return an angle in [-pi, pi), anything else as it is."""
    return (values + np.pi) % (2 * np.pi) - np.pi if quantity.periodic else values


@dataclass(frozen=True)
class Sensors:
    """The sensors of a data set.

    Args:
        streams: the randomness.
        noise_std: quantity -> standard deviation of its noise, in its unit; 0 where left out.

    """

    streams: Streams
    noise_std: Mapping[str, float] = field(default_factory=dict)

    def read(self, quantity: Quantity, exact: np.ndarray, number: int = 0, stream: str = "noise") -> np.ndarray:
        """Return what the sensor of a quantity records.

        Args:
            quantity: what is measured.
            exact: true values, (m,), in its unit.
            number: of the episode.
            stream: name of the stream of the noise.

        """
        noise = self.streams.of(f"{stream}.{quantity.name}", number).normal(size=len(exact))
        return wrapped(quantity, exact + self.noise_std.get(quantity.name, 0.0) * noise)
