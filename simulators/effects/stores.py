"""States that effects bring along: what a wall, a spring that creeps or a battery remembers of what went before."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import casadi

from simulators.effects.names import renamed, value_in
from simulators.effects.term import Store, Term
from simulators.effects.units import unit_in
from simulators.expression import Symbol
from simulators.model import Model, Quantity
from simulators.quantity import HIDDEN, ModelError

KEYS = ("rate", "unit", "range", "begins")


def check_states(where: str, states: Mapping[str, Any], parameters: Mapping[str, Any], *, plain: bool) -> None:
    """Refuse states of an effect that are not declared as such.

    Args:
        where: key of the effect.
        states: as given.
        parameters: of the effect, as given.
        plain: whether the effect has one term at one place.

    Raises:
        ModelError: what is wrong, what is allowed and the cure.
    """
    if states and not plain:
        raise ModelError(
            f"{where}.states: go with one `term` at one place; leave out `operator`, `mutual`, `passes`, `per`, parts"
        )
    strengths = [k for k, node in parameters.items() if isinstance(node, Mapping) and not node.get("neutral", 0)]
    if states and (len(states) != 1 or len(strengths) != 1):
        raise ModelError(
            f"{where}.states: {len(states)} states and {len(strengths)} parameters that are 0 where it is switched off "
            f"({', '.join(strengths) or 'none'}); give one state and one strength, and every other parameter a `neutral` value"
        )
    for name, node in states.items():
        ends = node.get("range") if isinstance(node, Mapping) else None
        if not (isinstance(node, Mapping) and "rate" in node and isinstance(ends, list | tuple) and len(ends) == 2):
            raise ModelError(f"{where}.states.{name}: {node!r}; write {{rate: ..., unit: ..., range: [low, high]}}")
        if unknown := sorted(set(node) - set(KEYS)):
            raise ModelError(f"{where}.states.{name}.{unknown[0]}: no such key; allowed are {', '.join(KEYS)}")


def stores_at(
    where: str,
    states: Mapping[str, Any],
    swap: Mapping[str, str],
    scales: Mapping[str, float],
    unit_of: Mapping[str, str],
) -> tuple[Store, ...]:
    """Return the states that an effect brings along at a place.

    Args:
        where: key of the effect.
        states: as declared.
        swap: name in its expressions -> name in the model.
        scales: of the place.
        unit_of: their units.
    """
    found = []
    for name, node in states.items():
        low, high = (value_in(v, scales, f"{where}.states.{name}.range") for v in node["range"])
        begins = node.get("begins", "")
        found.append(
            Store(
                swap[name],
                unit_in(node.get("unit", ""), unit_of),
                low,
                high,
                renamed(node["rate"], swap),
                swap.get(begins, begins),
            )
        )
    return tuple(found)


def stores_of(terms: Iterable[Term]) -> tuple[Store, ...]:
    """Return the states that terms bring along."""
    return tuple(store for term in terms for store in term.stores)


def with_stores(model: Model, stores: tuple[Store, ...]) -> Model:
    """Return the model with these states, which stand still until a term adds to their rates.

    Args:
        model: the simulator.
        stores: states; none that it has not yet: the model itself.
    """
    known = {q.name for q in model.states}
    stores = tuple(s for s in stores if s.name not in known)
    if not stores:
        return model
    nx = len(model.states)
    new = tuple(Quantity(s.name, s.unit, s.low, s.high, role=HIDDEN) for s in stores)

    def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return casadi.vertcat(model.rhs(x[:nx], u, p), model.symbol.zeros(len(new), 1))

    def output(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return model.output(x[:nx], u, p)

    return replace(model, states=(*model.states, *new), rhs=rhs, output=output, coordinates=None)
