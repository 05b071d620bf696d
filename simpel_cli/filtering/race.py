"""Fits race: one that can no longer come as far as it has to is left where it is.

A stage of a search fits many effects, each from several starts, and goes on with one. After a few iterations it shows which
have no chance: what a fit has reached so far, and a few times what a Newton step promises from there, is not enough.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simpel_cli.filtering.likelihood.fit import ROUND, Optimum

HOPED = 4.0  # times what a Newton step promises: as much as fits have gained beyond it
PATIENCE = 2 * ROUND  # iterations before that holds: from a start that is far off a step tells less
AT_FIRST = 10.0  # times, before
MARGIN = 10.0  # nats


def hopeful(optima: Sequence[Optimum], losses: Sequence[float]) -> list[bool]:
    """Return which fits may come to so small a loss."""
    hoped = [HOPED if o.iterations >= PATIENCE else AT_FIRST for o in optima]
    return [not o.loss - h * o.step > loss + MARGIN for o, h, loss in zip(optima, hoped, losses, strict=True)]


@dataclass(frozen=True)
class Race:
    """Which fits of a stage go on: all that may come as far as a share of the one that is ahead, the one of most evidence.

    A fit with many unknowns may have the least loss, and not be worth its unknowns.

    Args:
        loss: of the model before, nats.
        share: of what the best fit has gained, which the others have to be able to gain.
        counts: (L,) bool, which fits the others are compared with.
    """

    loss: float
    share: float
    counts: np.ndarray

    def __call__(self, optima: Sequence[Optimum]) -> list[bool]:
        """Return which go on, that with the least loss in any case."""
        gains = np.array([self.loss - o.loss for o in optima])
        worth = [o.log_evidence if counts else -np.inf for o, counts in zip(optima, self.counts, strict=True)]
        ahead = int(np.argmax(worth))
        best = max(float(gains[ahead]), 0.0) if np.isfinite(worth[ahead]) else 0.0
        going = hopeful(optima, [self.loss - self.share * best] * len(optima))
        going[int(np.argmax(gains))] = True
        return going
