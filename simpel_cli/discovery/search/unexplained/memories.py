"""A hidden state: what a chosen model leaves may have a memory that no state of the simulator has.

A wall takes up heat, a battery's voltage creeps after its current, friction gives before it slides: each is one more state z,
with a rate of its own, that nobody measures. A program carries no such state for every candidate. Along the filtered states of
a model its course is known, for a few shapes; what it would add to a rate, or to what a sensor reads, is linear in its
strength, so what it would earn in evidence is known to first order without a fit (`noise_profile`). The search is made once
more with the one that promises most, beside the chosen effects or in place of them.

Reference: Ljung (1999), System identification, 4.3 (state-space structures); Dahl (1968), A solid friction model.
"""

from collections.abc import Sequence
from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.discovery.search.trials import TIE
from simpel_cli.discovery.search.unexplained.drifts import OVER, drifting
from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile, evidence
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simpel_cli.filtering.likelihood.sensitivity import shifts
from simulators.effects import Term
from simulators.effects.term import RATE, SENSOR

SIZES = (0.3, 0.1, 0.03, 0.01, 0.003)  # of the range of its strength
MOST = 3  # that a program has room for
SHARE = 0.7  # of what the best promises, which the others have to
CERTAIN = 10.0  # nats that it has to promise


class Memory(NamedTuple):
    """Effects with a state of their own, best first, and what the best promises, nats."""

    terms: tuple[Term, ...]
    gain: float

    @property
    def label(self) -> str:
        """What they are called."""
        return " or ".join(t.label for t in self.terms)

    @property
    def words(self) -> str:
        """What is said of them."""
        return f"{self.label} promises +{self.gain:.0f}: searching once more with it"


def worth_a_search(levels: NoiseProfile, alone: NoiseProfile, terms: Sequence[Term]) -> tuple[Memory, bool] | None:
    """Return the effects with which a search is worth making again, and whether beside what it chose; None: there are none.

    Args:
        levels: of the chosen model.
        alone: of the simulator: what such a state explains, some effects together may have been chosen for.
        terms: candidates.
    """
    if not terms:
        return None
    chosen = levels.chosen.optimum.log_evidence - alone.chosen.optimum.log_evidence
    instead = _more_than_a_drift(alone, terms) if levels.chosen.terms else None
    if instead is not None and instead.gain > chosen - TIE:
        return instead, False
    beside = _more_than_a_drift(levels, terms)
    return None if beside is None else (beside, True)


def _more_than_a_drift(levels: NoiseProfile, terms: Sequence[Term]) -> Memory | None:
    """Return what is remembered unless a parameter that drifts promises more: a slow state fits a slow change, too."""
    found = remembered(levels, terms)
    drift = None if found is None else drifting(levels, (OVER,))
    return found if drift is None or found is None or found.gain > drift.gain else None


def remembered(levels: NoiseProfile, terms: Sequence[Term]) -> Memory | None:
    """Return the effects with a state of their own that promise most beside a model; None where none promises enough.

    Args:
        levels: of the model.
        terms: candidates, each with one state and one strength that is 0 where it is switched off.
    """
    gains = [_gain(levels, term) for term in terms]
    best = sorted(range(len(terms)), key=lambda i: -gains[i])[:MOST]
    if not best:
        return None
    gain = gains[best[0]] - float(np.log(len(terms) * len(SIZES)))
    alike = tuple(terms[i] for i in best if gains[i] > SHARE * gains[best[0]])
    return Memory(alike, gain) if gain > CERTAIN else None


def _gain(levels: NoiseProfile, term: Term) -> float:
    """Return the evidence that a term earns to first order at the best of its shapes and sizes, nats."""
    plan, chosen = levels.search.plan, levels.chosen
    coordinates, model = plan.coordinates, plan.augmented.model
    names = [q.name for q in model.states]
    rows = [r for r in plan.coordinates.driven if term.kind != RATE or names[r] == term.acts_on]
    here = [(row, level) for row in rows for level in levels(row)]
    strength = [i for i, k in enumerate(term.parameters) if k.neutral == 0]
    if not here or len(strength) != 1 or len(term.stores) != 1 or term.kind not in (RATE, SENSOR):
        return -np.inf
    own = [levels.search.terms[t] for t in chosen.terms]
    augmented = augment(model, [*own, term], plan.augmented.measured)
    z = chosen.optimum.z
    values = {q.name: coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    p = np.array([values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)])
    place, (first,) = augmented.rows(term), strength
    shapes = []
    for s in range(max(len(k.starts) for k in term.parameters)):
        at = p.copy()
        at[place] = [k.starts[min(s, len(k.starts) - 1)] for k in term.parameters]
        at[place[first]] = 1.0
        shapes.append(at)
    course = _Course(augmented, term, np.array(shapes), place[first])
    low, high = term.parameters[first].low, term.parameters[first].high
    ways = tuple(sign for sign, end in ((1.0, high), (-1.0, low)) if sign * end > 0)  # that its strength may have
    mean = np.asarray(here[0][1].track.mean)
    state = course.states(mean, here[0][1].inputs, _beginning(levels, term), model.dt)
    base = max(level.reached for _, level in here)
    return max(_earned(level, course, state, row, (high - low, ways), model.dt) - base for row, level in here)


def _beginning(levels: NoiseProfile, term: Term) -> np.ndarray:
    """Return where the state begins in every window, (W,)."""
    windows, model = levels.search.plan.windows, levels.search.plan.augmented.model
    begins = term.stores[0].begins
    states, inputs = [q.name for q in model.states], [q.name for q in model.inputs]
    if begins in states:
        return windows.start[:, states.index(begins)]
    if begins in inputs:
        return levels.inputs[:, 0, inputs.index(begins)]
    return np.zeros(len(windows.episode))


class _Course:
    """What a term with a state of its own does along known states, for S shapes side by side.

    Args:
        augmented: a model with the term.
        term: it.
        shapes: (S, dp) values of all parameters, its strength at 1.
        strength: place of that among them.
    """

    def __init__(self, augmented: Augmented, term: Term, shapes: np.ndarray, strength: int) -> None:
        self.shapes, self.term = shapes, term
        names = [q.name for q in augmented.model.states]
        self.store = names.index(term.stores[0].name)
        self.nx = len(names)
        x, u, p = (augmented.model.symbol.sym(n, augmented.function.size1_in(i)) for i, n in enumerate("xup"))
        rates, shown = augmented.function(x, u, p)
        place = names.index(term.acts_on) if term.kind == RATE else augmented.measured.index(term.acts_on)
        self.channel = None if term.kind == RATE else place
        slope = casadi.jacobian((rates if term.kind == RATE else shown)[place], p[strength])
        self.rate = casadi.Function("rate", [x, u, p], [rates[self.store]])
        self.slope = casadi.Function("slope", [x, u, p], [casadi.densify(slope)])

    def _points(self, known: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Put the state among the others, (..., nx) and (..., S) -> (nx, points); where it is known already it is replaced."""
        others = (
            known[..., None, :] if known.shape[-1] == self.nx else np.insert(known, self.store, 0.0, -1)[..., None, :]
        )
        x = np.array(np.broadcast_to(others, (*state.shape, self.nx)))
        x[..., self.store] = state
        return x.reshape(-1, self.nx).T

    def at(self, program: casadi.Function, known: np.ndarray, inputs: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return a program's value at known states (..., nx), inputs (..., nu) and the state (..., S)."""
        x = self._points(known, state)
        u = (
            np.broadcast_to(inputs[..., None, :], (*state.shape, inputs.shape[-1]))
            .reshape(state.size, inputs.shape[-1])
            .T
        )
        p = np.broadcast_to(self.shapes, (*state.shape, self.shapes.shape[1])).reshape(-1, self.shapes.shape[1]).T
        return np.nan_to_num(np.asarray(program(x, u, p)), posinf=0.0, neginf=0.0).reshape(state.shape)

    def states(self, known: np.ndarray, inputs: np.ndarray, start: np.ndarray, dt: float) -> np.ndarray:
        """Return the state along known ones, (W, T, S): one Runge-Kutta step a row, straight from one row to the next.

        Args:
            known: (W, T, nx) of the model without it.
            inputs: (W, T, nu).
            start: (W,) where it begins.
            dt: s.
        """
        count, rows = known.shape[:2]
        z = np.array(np.broadcast_to(start[:, None], (count, len(self.shapes))))
        found = [z]
        for k in range(rows - 1):
            here, there, u = known[:, k], known[:, k + 1], inputs[:, k]
            middle = (here + there) / 2
            a = self.at(self.rate, here, u, z)
            b = self.at(self.rate, middle, u, z + dt / 2 * a)
            c = self.at(self.rate, middle, u, z + dt / 2 * b)
            d = self.at(self.rate, there, u, z + dt * c)
            z = z + dt / 6 * (a + 2 * b + 2 * c + d)
            found.append(z)
        return np.stack(found, axis=1)


def _earned(
    level: Level, course: _Course, state: np.ndarray, row: int, strength: tuple[float, tuple[float, ...]], dt: float
) -> float:
    """Return the log-likelihood that a model at one level of the noise reaches with the best shape and size."""
    mean, following = np.asarray(level.track.mean), np.roll(np.asarray(level.track.predicted), -1, axis=1)
    here = course.at(course.slope, mean, level.inputs, state)  # (W, T, S)
    there = course.at(course.slope, following, level.inputs, np.roll(state, -1, axis=1))
    ok = level.per_std > 0
    if course.channel is None:
        moved = shifts(level.track, ok, {row: (here, there)}, dt)
    else:
        reading = np.zeros((*ok.shape, here.shape[-1]))
        reading[:, :, course.channel] = here
        moved = shifts(level.track, ok, {}, dt, reading)
    span, ways = strength
    columns = span * moved * level.per_std[..., None]
    flat, known = columns.reshape(level.error.size, -1), level.known.reshape(level.error.size, -1)
    flat = flat - known @ (known.T @ flat)
    error = level.error.ravel()
    # what a term does to the innovations of a model that has it: this one lacks it, so its strength has the other sign
    going = [f for f in flat.T if -np.sign(f @ error) in ways]
    gains = [evidence(f[None] @ f[:, None], np.array([f @ error]), np.array(SIZES)).max() for f in going]
    return level.reached + max(gains, default=-np.inf)
