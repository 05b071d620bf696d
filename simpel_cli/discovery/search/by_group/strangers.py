"""Errors of a model in which groups differ, on groups that it was not fitted to.

Nothing is known of a group that was never seen but the population. A model that knows every group of its own, and has so little
process noise as that needs, is overconfident there: one step ahead it would not follow what it cannot know. So it is predicted
by the same model with one value for all groups, and the noise that belongs to that.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from simpel_cli.discovery.search.by_group.own_parameters import in_common
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessment, Assessor
from simpel_cli.filtering.measurements.windows import Windows


def assessed(
    search: Search, assessor: Assessor, trial: Trial, windows: Windows,
    for_use: Callable[[Trial], Trial] = lambda trial: trial,
) -> Assessment:  # fmt: skip
    """Return the errors of a model on windows, of which some may be of groups that it was not fitted to.

    Args:
        search: that it comes from.
        assessor: of its program.
        trial: the model.
        windows: W of them.
        for_use: calibrates a model for what it will be used for.
    """
    found = assessor(trial.optimum.z, windows)
    spreads = _differing(search, trial)
    if not spreads:
        return found
    unseen = np.stack([_unseen(search, row, windows) for row in spreads])
    for pattern in np.unique(unseen, axis=1).T:  # what is known of the groups of another column stays
        if not pattern.any():
            continue
        gone = [row for row, new in zip(spreads, pattern, strict=True) if new]
        question = "in common", trial.terms, trial.optimum.z.tobytes(), *gone
        common = search.once(question, partial(_in_common, search, trial, gone, for_use))
        here = (unseen == pattern[:, None]).all(axis=0)
        found = jax.tree.map(partial(_either, here), found, assessor(common.optimum.z, windows))
    return found


def _in_common(search: Search, trial: Trial, spreads: list[int], for_use: Callable[[Trial], Trial]) -> Trial:
    return for_use(in_common(search, trial, spreads))


def _either(here: np.ndarray, known: Any, other: Any) -> Any:
    return np.where(here.reshape(-1, *(1,) * (known.ndim - 1)), other, known) if np.ndim(known) else known


def _differing(search: Search, trial: Trial) -> list[int]:
    """Return the spreads of what differs from group to group in a model."""
    z, free = trial.optimum.z, {*trial.optimum.free}
    return [row for row, members in search.spreads.items() if z[row] > 0 and free & {*members}]


def _unseen(search: Search, spread: int, windows: Windows) -> np.ndarray:
    """Return which windows are of none of the groups that were fitted, or are known, (W,)."""
    here: np.ndarray = windows.u[:, -1, search.other_slots[spread]] == 1
    return here
