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
from simpel_cli.filtering.setup import key_of
from simulators.effects import Term
from simulators.effects.term import PARAMETER

SIZES = (1.0, 0.3, 0.1)  # of a function, in standard deviations of its prior


class Promise(NamedTuple):
    """What a function would earn in evidence, nats, at the best of its sizes."""

    gain: float
    size: float


NOTHING = Promise(-np.inf, 1.0)


def promised(levels: NoiseProfile, terms: Sequence[Term]) -> list[Promise]:
    """Return what every function would earn beside the chosen terms.

    Args:
        levels: of the model that a search ended with.
        terms: functions without a name, none of them in the compiled program.
    """
    together: dict[
        object, list[int]
    ] = {}  # functions whose waves move the innovations in one run along the filter's track
    for i, term in enumerate(terms):
        together.setdefault(term.acts_on if term.kind == PARAMETER else key_of(term), []).append(i)
    found = [NOTHING] * len(terms)
    for group in together.values():
        for i, promise in zip(group, _promises(levels, [terms[i] for i in group]), strict=True):
            found[i] = promise
    return found


def changed_by(augmented: Augmented, term: Term) -> dict[str, float]:
    """Return the states whose rates a function changes, with how much its argument's parameter does; the model has the term."""
    return slopes_of(augmented).size[term.acts_on] if term.kind == PARAMETER else {term.acts_on: 1.0}


def _promises(levels: NoiseProfile, terms: Sequence[Term]) -> list[Promise]:
    """Return what functions promise that change the same rates; of one key the longest has the waves of all."""
    plan = levels.search.plan
    longest = {key_of(t): t for t in sorted(terms, key=lambda t: len(t.parameters))}
    augmented, p = _augmented(levels.search, levels.chosen, [*longest.values()])
    names = [k.name for t in longest.values() for k in t.parameters]
    own = [[names.index(k.name) for k in t.parameters] for t in terms]
    states = [q.name for q in plan.augmented.model.states]
    changed = [states.index(name) for name in changed_by(augmented, terms[0])]
    best = [NOTHING] * len(terms)
    for row in (row for row in changed if row in plan.coordinates.driven):
        here = levels(row)
        if not here:
            continue
        gains = [_gains(level, augmented, [*longest.values()], p, changed, own) for level in here]
        for i in range(len(terms)):
            reached = np.max([level.reached + each[i] for level, each in zip(here, gains, strict=True)], axis=0)
            by_size = reached - max(level.reached for level in here) - np.log(len(SIZES))
            size = int(np.argmax(by_size))
            best[i] = max(best[i], Promise(float(by_size[size]), SIZES[size]))
    return best


def _augmented(search: Search, chosen: Trial, terms: Sequence[Term]) -> tuple[Augmented, np.ndarray]:
    """Model with the chosen terms and some more, and the values of its parameters, the new ones switched off."""
    plan, z = search.plan, chosen.optimum.z
    augmented = augment(
        plan.augmented.model, [*(search.terms[t] for t in chosen.terms), *terms], plan.augmented.measured
    )
    values = {q.name: plan.coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    p = [values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)]
    return augmented, np.array(p)


def _gains(
    level: Level, augmented: Augmented, terms: Sequence[Term], p: np.ndarray, changed: Sequence[int],
    own: Sequence[Sequence[int]],
) -> list[np.ndarray]:  # fmt: skip
    """Evidence that functions of these rates earn at one level of the noise, at each of SIZES; own: the waves of each."""
    mean, following = np.asarray(level.track.mean), np.roll(level.track.predicted, -1, axis=1)
    forces = waves(augmented, terms, p, [(mean, level.inputs), (following, level.inputs)], changed)
    columns = shifts(level.track, level.per_std > 0, forces, augmented.model.dt) * level.per_std[..., None]
    count = level.error.size
    columns, known = columns.reshape(count, -1), level.known.reshape(count, -1)
    columns = columns - known @ (known.T @ columns)
    matrix, pull = columns.T @ columns, columns.T @ level.error.ravel()
    return [evidence(matrix[np.ix_(one, one)], pull[one], np.array(SIZES)) for one in own]
