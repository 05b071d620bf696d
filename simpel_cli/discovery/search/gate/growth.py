"""By how much errors grow from one model to another, in rows that both were fitted to, where they surely do."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.gate.held_out import Errors, growing
from simpel_cli.filtering.errors_ahead import rmse, with_lost
from simpel_cli.filtering.independent_parts import Parts, independent_parts


class Growth(NamedTuple):
    """An error that surely grows.

    Args:
        channel: whose error.
        ahead: how far, in words.
        times: how often it is as large.
    """

    channel: str
    ahead: str
    times: float


def growth(before: Errors, after: Errors, measured: Sequence[str], episode: np.ndarray) -> list[Growth]:
    """Return the errors that surely grow, by more than is tolerated (see `growing`).

    Args:
        before: errors of every measured channel, by horizon.
        after: of the other model.
        measured: names of the channels, ny.
        episode: that each window is of, (W,).
    """
    cut = {words: independent_parts(before[words], after[words], episode) for words in before}
    first, second, parts = ({words: getattr(c, of) for words, c in cut.items()} for of in Parts._fields)
    which = growing(first, second, measured, parts)
    found = []
    for words in before:
        for j, channel in enumerate(measured):
            if f"{channel} {words}" in which:
                small, large = (rmse(e[..., [j]]) for e in with_lost(before[words], after[words]))
                found.append(Growth(channel, words, float(large[0] / small[0])))
    return found
