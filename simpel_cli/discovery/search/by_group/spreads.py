"""Fits in which groups differ: the spread of their values is chosen by the evidence, beside everything else.

A fit holds the spread, and the spread follows from where the groups came to rest (`simpel_cli.priors.spreads`), their posterior
variance from the Laplace approximation. The evidence of a fit pays for having chosen it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.fit import MOST, Fitter, Hopes, Hypothesis, Optimum
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Setup
from simpel_cli.priors.spreads import LEAST, factor_of, sd_of_log
from simulators.groups import Grouping, groupings

BEGIN = 0.35  # of the largest spread, where a fit begins
ROUNDS = 4  # of fits with another spread
NEARLY = 0.1  # of a spread: it moves no more


class Known(NamedTuple):
    """What a fit says of the groups of one parameter.

    Args:
        squares: sum of squares of what the groups are, in standard deviations of the population.
        gamma: number of groups that the data know.
        size: number of groups.
    """

    squares: float
    gamma: float
    size: int

    @property
    def factor(self) -> float:
        """By what the spread is to be multiplied."""
        return float(factor_of(jnp.asarray(self.squares), jnp.asarray(self.gamma), self.size))

    @property
    def sd(self) -> float:
        """Standard deviation of the logarithm of the spread."""
        return float(sd_of_log(jnp.asarray(self.gamma)))


class Spreading:
    """A fitter that chooses the spreads of groups.

    Args:
        fitter: of hypotheses with given spreads.
        spreads: row of a spread -> rows of what the groups are.
    """

    def __init__(self, fitter: Fitter, spreads: Mapping[int, Sequence[int]]) -> None:
        self.fitter, self.spreads = fitter, spreads
        self.width, self.coordinates = fitter.width, fitter.coordinates

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = MOST, hopes: Hopes | None = None) -> list[Optimum]:
        """Fit every hypothesis; one that leaves windows out, or of a single iteration, keeps its spreads."""
        found = self.fitter(hypotheses, most, hopes)
        if most < MOST:
            return found
        moving = [
            i for i, h in enumerate(hypotheses)
            if np.all(h.weight == 1) and self._here(found[i]) and not found[i].left
        ]  # fmt: skip
        best = {i: self._paid(found[i]) for i in moving}
        for _ in range(ROUNDS):
            again = {}
            for i in moving:
                z = self._respread(found[i])
                if z is not None:
                    again[i] = Hypothesis(z, hypotheses[i].free, hypotheses[i].weight)
            moving = []
            for i, optimum in zip(again, self.fitter([*again.values()]), strict=True):
                found[i], paid = optimum, self._paid(optimum)
                if paid.log_evidence > best[i].log_evidence:
                    best[i] = paid
                    moving.append(i)
        return [best.get(i, optimum) for i, optimum in enumerate(found)]

    def on(self, windows: Windows) -> "Spreading":
        """Return the same for other windows."""
        return Spreading(self.fitter.on(windows), self.spreads)

    def within(self, coordinates: Coordinates) -> "Spreading":
        """Return the same with other bounds and priors."""
        return Spreading(self.fitter.within(coordinates), self.spreads)

    def of_noise(self) -> Fitter:
        """Return a fitter of the levels of noise alone, which has no spreads to choose."""
        return self.fitter.of_noise()

    def _here(self, optimum: Optimum) -> list[int]:
        """Spreads of parameters that differ in this fit."""
        free = set(optimum.free)
        return [row for row, own in self.spreads.items() if own and free.issuperset(own)]

    def _respread(self, optimum: Optimum) -> np.ndarray | None:
        """Return where to go on with other spreads, the groups where they are; None: the spreads are what they should be."""
        if not np.isfinite(optimum.log_evidence):
            return None
        levels = {}
        for row in self._here(optimum):
            level = share(optimum.z, row) * known(self.coordinates, optimum, self.spreads[row]).factor
            levels[row] = float(np.clip(level, LEAST, 1.0))
        if all(abs(np.log(level / share(optimum.z, row))) < NEARLY for row, level in levels.items()):
            return None
        return respread(self.coordinates, optimum.z, levels, self.spreads)

    def _paid(self, optimum: Optimum) -> Optimum:
        """Return the fit with the evidence that is left when its spreads are paid for: log s was anywhere."""
        cost = 0.0
        for row in self._here(optimum):
            sd = known(self.coordinates, optimum, self.spreads[row]).sd
            cost += max(float(np.log(-np.log(LEAST) / (sd * np.sqrt(2 * np.pi)))), 0.0)
        return optimum._replace(log_evidence=optimum.log_evidence - cost)


def known(coordinates: Coordinates, optimum: Optimum, rows: Sequence[int]) -> Known:
    """Return what a fit says of groups whose deltas are these rows."""
    squares, gamma = 0.0, 0.0
    for i in rows:
        k, span = optimum.free.index(i), coordinates.high[i] - coordinates.low[i]
        squares += coordinates.value(i, float(optimum.z[i])) ** 2
        gamma += 1 - min(float(optimum.covariance[k, k]) * span**2, 1.0)
    return Known(squares, gamma, len(rows))


def share(z: np.ndarray, row: int) -> float:
    """Return a spread as a share of the largest."""
    return max(float(z[row]), LEAST)


def respread(
    coordinates: Coordinates, z: np.ndarray, levels: Mapping[int, float], spreads: Mapping[int, Sequence[int]]
) -> np.ndarray:
    """Return unit coordinates with other spreads in which the groups are where they were.

    Args:
        coordinates: of all unknowns.
        z: unit coordinates.
        levels: row of a spread -> share of the largest.
        spreads: row of a spread -> rows of what the groups are.
    """
    z = z.copy()
    for row, level in levels.items():
        before, after = (coordinates.value(row, v) for v in (share(z, row), level))
        for i in spreads[row]:
            z[i] = coordinates.unit(i, before / after * coordinates.value(i, float(z[i])))
        z[row] = level
    return z


def slots_of(plan: Setup, own: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return what every group is -> the input that says that a row is of it."""
    inputs, names = _names(plan)
    of_effects, of_simulator = _groupings(plan)
    found = {
        names.index(q.name): inputs.index(slot) for g in of_effects for q, slot in zip(g.members, g.slots, strict=True)
    }
    for g in of_simulator:
        if names.index(g.spread.name) in own:  # without the group that was never seen
            seen = zip(g.members[:-1], g.slots[:-1], strict=True)
            found |= {names.index(q.name): inputs.index(slot) for q, slot in seen}
    return found


def other_slots(plan: Setup) -> dict[int, int]:
    """Return every spread -> the input that says that a row is of none of the groups."""
    inputs, names = _names(plan)
    return {names.index(g.spread.name): inputs.index(g.slots[-1]) for of in _groupings(plan) for g in of}


def _names(plan: Setup) -> tuple[list[str], list[str]]:
    """Return the names of inputs, and of parameters."""
    return [q.name for q in plan.augmented.model.inputs], [q.name for q in plan.augmented.params]


def _groupings(plan: Setup) -> tuple[list[Grouping], list[Grouping]]:
    """Return how parameters of effects differ between groups, and how those of the simulator do."""
    model = plan.augmented.model
    of_effects = [g for term in plan.augmented.terms for g in term.groupings]
    return of_effects, groupings(model.base, model.groups) if model.base else []
