"""Named streams of random numbers, all derived from one seed: what one stream draws never depends on the others."""

from typing import NamedTuple
from zlib import crc32

import numpy as np


class Streams(NamedTuple):
    """All randomness of a data set."""

    seed: int

    def of(self, name: str, number: int = 0) -> np.random.Generator:
        """Return the stream of a name, begun anew.

        Args:
            name: what is drawn, e.g. `noise.phi`.
            number: of the episode, or of the group that it is drawn for.

        """
        return np.random.default_rng([self.seed, crc32(name.encode()), number])
