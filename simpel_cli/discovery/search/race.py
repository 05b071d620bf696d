"""The fits of a stage race: one that can no longer do as well as others is left where it is.

A stage fits many effects, each from several starts, and goes on with one. After a few iterations it shows which have no chance:
what a fit has gained so far, and a few times what a Newton step promises from there, is less than a share of what the best one
has gained already.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.filtering.likelihood.fit import Optimum

HOPED = 4.0  # times what a Newton step promises: as much as fits have gained beyond it
MARGIN = 10.0  # nats


class Race(NamedTuple):
    """Which fits of a stage go on.

    Args:
        loss: of the model before, nats.
        share: of what the best fit has gained, which the others have to be able to reach.
        counts: which fits the others are compared with.
        gained: nats that something else has gained already.
    """

    loss: float
    share: float
    counts: Sequence[bool]
    gained: float = 0.0

    def __call__(self, optima: Sequence[Optimum]) -> list[bool]:
        """Return which go on."""
        gains = np.array([self.loss - o.loss for o in optima])
        own = gains[np.array(self.counts, bool) & np.isfinite(gains)]
        needed = self.share * max(own.max(initial=0.0), self.gained) - MARGIN
        return [not gain + HOPED * o.step < needed for gain, o in zip(gains, optima, strict=True)]
