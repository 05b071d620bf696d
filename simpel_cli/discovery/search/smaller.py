"""Programs with few terms or none beside the whole one: they compile and run in a fraction of its time."""

from collections.abc import Sequence

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Setup, key_of


def fitter_of(plan: Setup, side_by_side: int, room: int) -> Fitter:
    """Return a fitter with room for so many unknowns beside those of the simulator and the noise."""
    width = len(plan.augmented.model.params) + plan.coordinates.sizes[1] + plan.coordinates.sizes[2] + room
    return Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=side_by_side, width=width)


def small_search(plan: Setup, side_by_side: int, room: int, alike: Sequence[int] = ()) -> Search:
    """Return a search in a program of its own, with room as of `fitter_of`; alike: as of `Search`."""
    return Search(plan, fitter_of(plan, side_by_side, room), alike=alike)


def fitted_again(small: Search, search: Search, chosen: Trial) -> Trial:
    """Fit the terms that were chosen in one search in the smaller program of another, in the same order."""
    names = [key_of(t) for t in small.terms]
    own = tuple(names.index(key_of(search.terms[t])) for t in chosen.terms)
    start = Hypothesis(carried(search.plan, chosen.optimum.z, small.plan), small.free(own), small.ones)
    return small.best(own, small.fitter([start]))


def carried(old: Setup, z: np.ndarray, new: Setup) -> np.ndarray:
    """Carry unit coordinates from one setup to another, by the names of parameters, channels and driven states.

    What is switched off by a neutral value beyond its range stays so.
    """
    values = {name: old.coordinates.value(i, float(z[i])) for i, name in enumerate(names_of(old)) if 0 <= z[i] <= 1}
    start = new.start.copy()
    for i, name in enumerate(names_of(new)):
        if name in values:
            start[i] = new.coordinates.unit(i, values[name])
    return start


def carried_windows(old: Setup, new: Setup) -> Windows:
    """Return the windows of one setup in another of the same measurements; what only that knows begins as it says."""
    known, names = ([q.name for q in plan.augmented.model.states] for plan in (old, new))
    start, spread = new.windows.start.copy(), new.windows.spread.copy()
    both = [name for name in names if name in known]
    there, here = [names.index(name) for name in both], [known.index(name) for name in both]
    start[:, there], spread[:, there] = old.windows.start[:, here], old.windows.spread[:, here]
    return old.windows._replace(start=start, spread=spread)


def names_of(plan: Setup) -> list[str]:
    """Return a name for every unknown of a setup."""
    states = [q.name for q in plan.augmented.model.states]
    return [
        *(q.name for q in plan.augmented.params),
        *(f"noise of {name}" for name in plan.augmented.measured),
        *(f"process noise of {states[i]}" for i in plan.coordinates.driven),
    ]
