"""What functions of two arguments promise to a model that is fitted already, before any of them is compiled.

Their size is not known: a few are tried, as equally probable, for with the prior of a large function a small one would never
earn its complexity.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile, evidence
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simpel_cli.filtering.likelihood.sensitivity import shifts, waves
from simulators.effects import Term

SIZES = (1.0, 0.3, 0.1)  # of a function, in standard deviations of its prior


class Promise(NamedTuple):
    """What a function would earn in evidence, nats, at the best of its sizes."""

    gain: float
    size: float


def promised(levels: NoiseProfile, terms: Sequence[Term]) -> list[Promise]:
    """Return what every function would earn beside the chosen terms.

    Args:
        levels: of the model that a search ended with.
        terms: functions without a name, none of them in the compiled program.
    """
    plan = levels.search.plan
    states = [q.name for q in plan.augmented.model.states]
    found = []
    for term in terms:
        row = states.index(term.acts_on)
        here = levels(row) if row in plan.coordinates.driven else []
        if not here:
            found.append(Promise(-np.inf, 1.0))
            continue
        augmented, p = _augmented(levels.search, levels.chosen, term)
        reached = np.max(
            [level.reached + _gains(plan.augmented.model.dt, level, augmented, term, p, row) for level in here], 0
        )
        by_size = reached - max(level.reached for level in here) - np.log(len(SIZES))
        best = int(np.argmax(by_size))
        found.append(Promise(float(by_size[best]), SIZES[best]))
    return found


def _augmented(search: Search, chosen: Trial, term: Term) -> tuple[Augmented, np.ndarray]:
    """Model with the chosen terms and one more, and the values of its parameters, the new one switched off."""
    plan, z = search.plan, chosen.optimum.z
    augmented = augment(plan.augmented.model, [*(search.terms[t] for t in chosen.terms), term], plan.augmented.measured)
    values = {q.name: plan.coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    p = [values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)]
    return augmented, np.array(p)


def _gains(dt: float, level: Level, augmented: Augmented, term: Term, p: np.ndarray, row: int) -> np.ndarray:
    """Evidence that a function earns at one level of the noise, at each of SIZES."""
    mean, following = np.asarray(level.track.mean), np.roll(level.track.predicted, -1, axis=1)
    here, there = waves(augmented, term, p, [(mean, level.inputs), (following, level.inputs)])
    columns = shifts(level.track, level.per_std > 0, here, there, row, dt) * level.per_std[..., None]
    count = level.error.size
    columns, known = columns.reshape(count, -1), level.known.reshape(count, -1)
    columns = columns - known @ (known.T @ columns)
    return evidence(columns.T @ columns, columns.T @ level.error.ravel(), np.array(SIZES))
