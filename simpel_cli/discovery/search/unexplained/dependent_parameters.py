"""Parameters that are functions of a state or an input: of the simulator, or sizes of the effects that were chosen.

    d(x)/dt = f(x, u, p + delta(a)),   delta(a) = sum_j w_j phi_j(a),   a a state or an input

Friction that is larger at some angles, a loss that a fan changes, a pump that is weaker against a head. Such a function has
far fewer weights than one of two arguments, so that fewer data tell of it, and it says more.

Reference: Young (2000), Stochastic, dynamic modelling and signal processing: time variable and state dependent parameter
estimation, in Nonlinear and nonstationary signal processing (state-dependent parameters).
"""

from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.likelihood.augmented import Augmented, augment
from simulators.effects import Scales, Term, dependent
from simulators.effects.unnamed import arguments_of
from simulators.expression import Symbol
from simulators.groups import MEMBER, SPREAD


class Slopes(NamedTuple):
    """What the parameters of a model do to its rates.

    Args:
        arguments: parameter -> state -> the states and inputs that the slope of its rate depends on; only where it has one.
        linear: parameters that all rates are linear in.
    """

    arguments: dict[str, dict[str, frozenset[str]]]
    linear: frozenset[str]


def dependent_parameters(search: Search, chosen: Trial, scales: Scales, bases: int) -> list[Term]:
    """Return every free parameter of the simulator and size of the chosen effects as a function of every state and input.

    Functions that come to a force of one argument are left out: these were tried as such.

    Args:
        search: over sets of effects.
        chosen: a model of it.
        scales: magnitudes.
        bases: waves of the argument.
    """
    plan = search.plan
    effects = [search.terms[t] for t in chosen.terms]
    augmented = augment(plan.augmented.model, effects, plan.augmented.measured)
    model, rows = augmented.model, {q.name: i for i, q in enumerate(plan.augmented.params)}
    free = {name for name, i in rows.items() if i in chosen.optimum.free}
    asked = [(q.name, q.unit, q.high - q.low) for q in model.params if q.role not in (SPREAD, MEMBER)]
    slopes = slopes_of(augmented)
    sizes = [k for t in effects if not t.groupings for k in t.parameters if k.name in slopes.linear]
    asked += [(k.name, k.unit, k.high - k.low) for k in sizes]
    found = []
    for name, unit, declared in (one for one in asked if one[0] in free):
        low, high = (float(getattr(plan.coordinates, end)[rows[name]]) for end in ("low", "high"))
        span = declared if plan.coordinates.log[rows[name]] else high - low
        found += [
            dependent(model, scales, name, argument, unit, span, bases)
            for argument in arguments_of(model)
            if any(len(others | {argument}) > 1 for others in slopes.arguments[name].values())
        ]
    return found


def slopes_of(augmented: Augmented) -> Slopes:
    """Return which parameters change which rates, and what else these slopes depend on."""
    function = augmented.function
    symbols = {n: augmented.model.symbol.sym(n, function.size1_in(i)) for i, n in enumerate("xup")}
    x, u, p = symbols.values()
    slope = casadi.jacobian(function(x, u, p)[0], p)
    states, inputs = ([q.name for q in group] for group in (augmented.model.states, augmented.model.inputs))
    found, linear = {}, set()
    for i, q in enumerate(augmented.params):
        column = casadi.densify(slope[:, i])
        if not _touched(column, p)[:, i].any():
            linear.add(q.name)
        on_states, on_inputs = _touched(column, x), _touched(column, u)
        found[q.name] = {
            state: frozenset(
                [n for n, on in zip(states, on_states[r], strict=True) if on]
                + [n for n, on in zip(inputs, on_inputs[r], strict=True) if on]
            )
            for r, state in enumerate(states)
            if slope.sparsity().has_nz(r, i) and state in augmented.roles.dynamic
        }
    return Slopes(found, frozenset(linear))


def _touched(expression: Symbol, symbol: Symbol) -> np.ndarray:
    """Return which entries of an expression depend on which of a symbol, (n, m)."""
    if not symbol.numel():
        return np.zeros((expression.numel(), 0), bool)
    return np.array(casadi.DM(casadi.jacobian_sparsity(expression, symbol), 1).full(), bool)
