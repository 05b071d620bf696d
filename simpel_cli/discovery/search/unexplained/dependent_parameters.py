"""Parameters that are functions of a state or an input: of the simulator, or sizes of the effects that were chosen.

    d(x)/dt = f(x, u, p + delta(a)),   delta(a) = sum_j w_j phi_j(a),   a a state or an input

Friction that is larger at some angles, a loss that a fan changes, a pump that is weaker against a head. Such a function has
far fewer weights than one of two arguments, so that fewer data tell of it, and it says more.

Reference: Young (2000), Stochastic, dynamic modelling and signal processing: time variable and state dependent parameter
estimation, in Nonlinear and nonstationary signal processing (state-dependent parameters).
"""

from collections.abc import Sequence
from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simulators.effects import Term, dependent
from simulators.effects.unnamed import arguments_of
from simulators.groups import MEMBER, SPREAD

POINTS = 64  # at which the slopes are compared
SAME = 1e-9  # of a slope: below, rounding


class Slopes(NamedTuple):
    """What the parameters of a model do to its rates.

    Args:
        arguments: parameter -> state -> the states and inputs that the slope of its rate depends on; only where it has one.
        size: likewise, root mean square of the slope.
        linear: parameters that all rates are linear in.
    """

    arguments: dict[str, dict[str, frozenset[str]]]
    size: dict[str, dict[str, float]]
    linear: frozenset[str]


def dependent_parameters(search: Search, chosen: Trial, bases: Sequence[int]) -> list[Term]:
    """Return every free parameter of the simulator and size of the chosen effects as a function of every state and input.

    Functions that come to a force of one argument on one rate are left out: these were tried as such.

    Args:
        search: over sets of effects.
        chosen: a model of it.
        bases: numbers of waves of the argument, of which each gives a function.
    """
    plan = search.plan
    effects = [search.terms[t] for t in chosen.terms]
    augmented = augment(plan.augmented.model, effects, plan.augmented.measured)
    model, rows = augmented.model, {q.name: i for i, q in enumerate(plan.augmented.params)}
    asked = [(q.name, q.unit) for q in model.params if q.role not in (SPREAD, MEMBER)]
    slopes, arguments = slopes_of(augmented), arguments_of(model)
    asked += [(k.name, k.unit) for t in effects if not t.groupings for k in t.parameters if k.name in slopes.linear]
    found = []
    for name, unit in asked:
        if rows[name] not in chosen.optimum.free:
            continue
        span = plan.coordinates.span(rows[name], float(chosen.optimum.z[rows[name]]))
        of_rates = [others.intersection(arguments) for others in slopes.arguments[name].values()]
        found += [
            dependent(model, plan.scales, (name, label_of(name, effects)), argument, unit, span, n)
            for argument in arguments
            if len(of_rates) > 1 or any(len(others | {argument}) > 1 for others in of_rates)
            for n in bases
        ]
    return found


def label_of(parameter: str, effects: Sequence[Term]) -> str:
    """Return what a parameter is called, of the simulator or of an effect."""
    own = (f"{k.label} of {t.label}" for t in effects for k in t.parameters if k.name == parameter)
    return next(own, parameter)


def slopes_of(augmented: Augmented) -> Slopes:
    """Return which parameters change which rates, and what else these slopes depend on.

    Read off numbers: a mass that cancels out of a weight is no function of the angle, whatever the expression says.
    """
    function, model = augmented.function, augmented.model
    symbols = [model.symbol.sym(n, function.size1_in(i)) for i, n in enumerate("xup")]
    slope = casadi.Function(
        "slope", symbols, [casadi.vec(casadi.densify(casadi.jacobian(function(*symbols)[0], symbols[2])))]
    )
    quantities = [*model.states, *model.inputs, *augmented.params]
    low, high = (np.array([getattr(q, end) for q in quantities])[:, None] for end in ("low", "high"))
    random, splits = np.random.default_rng(0), np.cumsum([len(model.states), len(model.inputs)])

    def at(points: np.ndarray) -> np.ndarray:
        found = np.nan_to_num(np.asarray(slope(*np.split(points, splits))), posinf=0.0, neginf=0.0)
        return found.reshape(len(augmented.params), len(model.states), -1).swapaxes(0, 1)  # (nx, np, POINTS)

    points, others = random.uniform(low, high, (2, len(low), POINTS))
    here = at(points)
    touched = np.zeros((len(quantities), *here.shape[:2]), bool)
    for i, there in enumerate(others):
        moved = at(np.where(np.arange(len(low))[:, None] == i, there, points))
        touched[i] = np.any(np.abs(moved - here) > SAME * np.maximum(np.abs(moved), np.abs(here)), axis=2)
    changes = np.any(here != 0, axis=2)
    names, roles = [q.name for q in quantities[: splits[1]]], augmented.roles.dynamic
    arguments = {
        q.name: {
            state.name: frozenset(n for n, on in zip(names, touched[:, r, i], strict=False) if on)
            for r, state in enumerate(model.states)
            if changes[r, i] and state.name in roles
        }
        for i, q in enumerate(augmented.params)
    }
    sizes = np.sqrt(np.mean(here**2, axis=2))
    rows = {state.name: r for r, state in enumerate(model.states)}
    columns = {q.name: i for i, q in enumerate(augmented.params)}
    size = {name: {state: float(sizes[rows[state], columns[name]]) for state in own} for name, own in arguments.items()}
    linear = {q.name for i, q in enumerate(augmented.params) if not touched[splits[1] + i, :, i].any()}
    return Slopes(arguments, size, frozenset(linear))
