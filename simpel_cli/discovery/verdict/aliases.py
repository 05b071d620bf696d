"""Effects that are the same in a given model, so that no data can distinguish them.

An offset of a motor's voltage and a constant load are the same force if the voltage enters with a constant gain, and differ
otherwise: this depends on the model.
"""

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simulators.effects import Term
from simulators.effects.term import DELAY, OPERATORS, SENSOR, SENSOR_DELAY
from simulators.groups import slots_of

POINTS = 64
SAME = 1e-6  # of the larger function


def of_structure(search: Search, term: Term) -> list[Term]:
    """Return the terms that the structure of the model makes the same as a delay, whatever the evidence says.

    Where one input drives the system and one sensor sees it, a late input is a late sensor: only what lies before the first
    row tells them apart, and of that nothing was recorded.
    """
    model = search.plan.augmented.model
    slots = {model.inputs[j].name for of in slots_of(model) for j in of}  # which group an episode is of never changes
    driven = [q.name for q in model.inputs if q.name not in slots]
    if term.kind not in (DELAY, SENSOR_DELAY) or len(driven) != 1 or len(search.plan.augmented.measured) != 1:
        return []
    other = SENSOR_DELAY if term.kind == DELAY else DELAY
    return [t for t in search.terms if t.kind == other]


def are_aliases(search: Search, chosen: Trial, first: tuple[int, Trial], second: tuple[int, Trial]) -> bool:
    """Whether two fitted terms do the same, but for a factor, all over the model's ranges.

    Args:
        search: whose terms they are.
        chosen: fit that the rest of the model is taken from.
        first: a term, and the fit that its size is taken from.
        second: likewise.
    """
    if any(search.terms[t].kind in (*OPERATORS, SENSOR) for t, _ in (first, second)):
        return False
    model = search.plan.augmented.model
    random = np.random.default_rng(0)
    x, u = (
        np.array([random.uniform(q.low, q.high, POINTS) for q in group]).reshape(len(group), POINTS)
        for group in (model.states, model.inputs)
    )
    a, b = (_pushes(search, chosen, term, fitted, x, u) for term, fitted in (first, second))
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    if not np.isfinite(size) or size == 0:
        return False
    return 1 - abs(float(np.sum(a * b))) / size < SAME


def _pushes(search: Search, chosen: Trial, term: int, fitted: Trial, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the change of the rates by a term at its fitted size, (nx, points); the rest of the model as in `chosen`."""
    coordinates, function = search.plan.coordinates, search.plan.augmented.function
    off = search.off(chosen.optimum.z, chosen.terms)
    on = off.copy()
    rows = search.all_rows(term)
    on[rows] = fitted.optimum.z[rows]
    rates = []
    for z in (on, off):
        p = np.array([coordinates.value(i, float(z[i])) for i in range(coordinates.sizes[0])])
        rates.append(np.asarray(function(x, u, np.tile(p[:, None], x.shape[1]))[0]))
    return rates[0] - rates[1]
