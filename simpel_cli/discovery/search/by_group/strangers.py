"""Errors of a model in which groups differ, on groups that it was not fitted to.

Nothing is known of a group that was never seen but the population. A model that knows every group of its own, and has so little
process noise as that needs, is overconfident there: one step ahead it would not follow what it cannot know. So it is predicted
by the same model with one value for all groups, and the noise that belongs to that.
"""

from functools import partial
from typing import Any

import jax
import numpy as np

from simpel_cli.discovery.search.by_group.own_parameters import in_common
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessment, Assessor
from simpel_cli.filtering.measurements.windows import Windows


def assessed(search: Search, assessor: Assessor, trial: Trial, windows: Windows) -> Assessment:
    """Return the errors of a model on windows, of which some may be of groups that it was not fitted to.

    Args:
        search: that it comes from.
        assessor: of its program.
        trial: the model.
        windows: W of them.
    """
    found = assessor(trial.optimum.z, windows)
    spreads = _differing(search, trial)
    unseen = np.any([_unseen(search, row, windows) for row in spreads], axis=0) if spreads else np.zeros(0, bool)
    if not unseen.any():
        return found
    question = "in common", trial.terms, trial.optimum.z.tobytes()
    common = search.once(question, partial(in_common, search, trial, spreads))

    def each(known: Any, other: Any) -> Any:
        return np.where(unseen.reshape(-1, *(1,) * (known.ndim - 1)), other, known) if np.ndim(known) else known

    return jax.tree.map(each, found, assessor(common.optimum.z, windows))


def _differing(search: Search, trial: Trial) -> list[int]:
    """Return the spreads of what differs from group to group in a model."""
    z, free = trial.optimum.z, {*trial.optimum.free}
    return [row for row, members in search.spreads.items() if z[row] > 0 and free & {*members}]


def _unseen(search: Search, spread: int, windows: Windows) -> np.ndarray:
    """Return which windows are of none of the groups that were fitted, (W,)."""
    slots = [search.slot_of[row] for row in search.spreads[spread] if row in search.slot_of]
    return ~(windows.u[:, -1, slots] == 1).any(axis=1)
