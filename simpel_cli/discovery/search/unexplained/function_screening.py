"""What functions without a name promise to a model that is fitted already, before any of them is compiled.

Their size is not known: a few are tried, as equally probable, for with the prior of a large function a small one would never
earn its complexity.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.dependent_parameters import slopes_of
from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile, evidence
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simpel_cli.filtering.likelihood.sensitivity import shifts, waves
from simulators.effects import Term
from simulators.effects.term import PARAMETER

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
    search = levels.search
    driven, states = search.plan.coordinates.driven, [q.name for q in search.plan.augmented.model.states]
    found = []
    for term in terms:
        augmented, p = _augmented(search, levels.chosen, term)
        changed = [i for i, name in enumerate(states) if name in changed_by(augmented, term)]
        tried = [_promise(levels, levels(row), augmented, term, p, changed) for row in changed if row in driven]
        found.append(max(tried, default=Promise(-np.inf, 1.0)))
    return found


def changed_by(augmented: Augmented, term: Term) -> list[str]:
    """Return the states whose rates a function changes; augmented: a model that has it."""
    if term.kind != PARAMETER:
        return [term.acts_on]
    slopes = slopes_of(augmented)
    return sorted({state for k in term.parameters for state in slopes.arguments[k.name]})


def _promise(
    levels: NoiseProfile, here: Sequence[Level], augmented: Augmented, term: Term, p: np.ndarray, changed: Sequence[int]
) -> Promise:  # fmt: skip
    if not here:
        return Promise(-np.inf, 1.0)
    dt = levels.search.plan.augmented.model.dt
    reached = np.max([level.reached + _gains(dt, level, augmented, term, p, changed) for level in here], 0)
    by_size = reached - max(level.reached for level in here) - np.log(len(SIZES))
    best = int(np.argmax(by_size))
    return Promise(float(by_size[best]), SIZES[best])


def _augmented(search: Search, chosen: Trial, term: Term) -> tuple[Augmented, np.ndarray]:
    """Model with the chosen terms and one more, and the values of its parameters, the new one switched off."""
    plan, z = search.plan, chosen.optimum.z
    augmented = augment(plan.augmented.model, [*(search.terms[t] for t in chosen.terms), term], plan.augmented.measured)
    values = {q.name: plan.coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    p = [values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)]
    return augmented, np.array(p)


def _gains(
    dt: float, level: Level, augmented: Augmented, term: Term, p: np.ndarray, changed: Sequence[int]
) -> np.ndarray:
    """Evidence that a function of these rates earns at one level of the noise, at each of SIZES."""
    mean, following = np.asarray(level.track.mean), np.roll(level.track.predicted, -1, axis=1)
    points, states = [(mean, level.inputs), (following, level.inputs)], augmented.model.states
    moved = []
    for row in changed:
        here, there = waves(augmented, term, p, points, states[row].name)
        moved.append(shifts(level.track, level.per_std > 0, here, there, row, dt))
    columns = sum(moved) * level.per_std[..., None]
    count = level.error.size
    columns, known = columns.reshape(count, -1), level.known.reshape(count, -1)
    columns = columns - known @ (known.T @ columns)
    return evidence(columns.T @ columns, columns.T @ level.error.ravel(), np.array(SIZES))
