"""A simulator with terms added to it: what `simpel discover` writes where the equations are in Python, not in YAML."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

from simulators.definitions import UNCERTAIN, read_groupings
from simulators.expression import Symbol
from simulators.model import Model, ModelError, column
from simulators.quantity import (
    GIVEN,
    TIMES,
    Quantity,
    check_free,
    check_keys,
    check_model_name,
    check_spelling,
    read_between_rows,
    read_number,
    read_term,
    read_times,
    read_uncertain,
    refuse_unknown,
)
from simulators.readings import with_sensors
from simulators.sections import NUMBER, SECTIONS, either, keys, named

INPUT = ("value", *GIVEN)


class Base(Protocol):
    """Whatever a `sim:` node declares."""

    def model(self) -> Any:
        """Return the model."""


@dataclass(frozen=True)
class Extended:
    """A simulator with further parameters and terms.

    A transition is then integrated in the states, also where the simulator alone has coordinates of its own (whose limits are
    lost with them).

    Args:
        name: letters, digits and single underscores.
        base: node of the simulator that the terms are added to.
        parameters: name: {unit, range, prior, per, spread, groups} or a number, as those of `Declared`.
        inputs: input: {value: expression in its place, delay, lag, between_rows}, each if there is one; see `Declared`.
        dynamics: state: expression that is added to its rate, in states, inputs, parameters, and rate_STATE for the rate that
            the simulator itself has.
        sensors: state or output: {value, lag, delay}; what its column shows, see `Declared`.

    Raises:
        ModelError: names the key, what it holds, what is allowed and the cure.

    """

    name: str
    base: Base
    parameters: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    dynamics: dict[str, Any] = field(default_factory=dict)
    sensors: dict[str, Any] = field(default_factory=dict)

    sections: ClassVar[dict[str, Any]] = {  # JSON schemas of fields
        "parameters": named(either(NUMBER, keys(UNCERTAIN, ("range",)))),
        "inputs": named(keys(INPUT)),
        "dynamics": SECTIONS["dynamics"],
        "sensors": SECTIONS["sensors"],
    }

    def model(self) -> Model:
        """Check everything and build the model."""
        check_model_name(self.name)
        try:
            base = self.base.model()
        except ModelError as error:
            raise ModelError(re.sub(r"^sim\.", "sim.base.", str(error))) from None
        if not isinstance(base, Model):
            raise ModelError(
                "sim.base: a world shows no equations that terms could be added to; give a simulator in symbols"
            )
        taken = {q.name for q in (*base.states, *base.inputs, *base.params, *base.outputs)} | base.fixed.keys()
        taken |= {f"rate_{q.name}" for q in base.states}
        own: list[Quantity] = []
        fixed: dict[str, float] = {}
        for name, node in self.parameters.items():
            path = f"sim.parameters.{name}"
            check_spelling("sim.parameters", name)
            check_free(path, name)
            if name in taken:
                raise ModelError(f"{path}: the name is taken by sim.base; choose another name")
            if isinstance(node, Mapping):
                own.append(read_uncertain(path, name, node))
            else:
                fixed[name] = read_number(path, node)
        _known("inputs", self.inputs, base.inputs)
        _known("dynamics", self.dynamics, base.states)
        for name, node in self.inputs.items():
            check_keys(f"sim.inputs.{name}", node, INPUT)
        params = (*base.params, *own)
        values = {name: node["value"] for name, node in self.inputs.items() if "value" in node}

        def named(p: Symbol) -> dict[str, Symbol]:
            scope: dict[str, Symbol] = {name: base.symbol(value) for name, value in (base.fixed | fixed).items()}
            return scope | {q.name: p[i] for i, q in enumerate(params)}

        def known(x: Symbol, u: Symbol, p: Symbol) -> dict[str, Symbol]:
            scope = named(p)
            for group, rows in ((base.states, x), (base.inputs, u)):
                scope |= {q.name: rows[i] for i, q in enumerate(group)}
            # each of the inputs as they are given, whichever of them is changed first
            return scope | {
                name: read_term(f"sim.inputs.{name}.value", formula, scope) for name, formula in values.items()
            }

        def given(scope: dict[str, Symbol]) -> Symbol:
            return column(base.symbol, [scope[q.name] for q in base.inputs])

        def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
            scope = known(x, u, p)
            rates = base.rhs(x, given(scope), p[: len(base.params)])
            scope |= {f"rate_{q.name}": rates[i] for i, q in enumerate(base.states)}
            added = {name: read_term(f"sim.dynamics.{name}", text, scope) for name, text in self.dynamics.items()}
            return column(base.symbol, [rates[i] + added.get(q.name, 0) for i, q in enumerate(base.states)])

        per, spreads, known_groups = read_groupings(self.parameters)
        late = {key: getattr(base, key) | read_times(key, self.inputs, params, base.fixed | fixed) for key in TIMES}
        model = replace(
            base,
            name=self.name,
            params=params,
            rhs=rhs,
            output=lambda x, u, p: base.output(x, given(known(x, u, p)), p[: len(base.params)]),
            fixed=base.fixed | fixed,
            per=base.per | per,
            spreads=base.spreads | spreads,
            known_groups=base.known_groups | known_groups,
            coordinates=None if self.dynamics or values else base.coordinates,
            between_rows=base.between_rows | read_between_rows(self.inputs),
            **late,
        )
        model = with_sensors(model, self.sensors, named)
        model.function()  # reads every expression once, so that an error surfaces here and not at first use
        return model


def _known(section: str, given: Mapping[str, Any], quantities: tuple[Quantity, ...]) -> None:
    names = [q.name for q in quantities]
    for name in given:
        if name not in names:
            refuse_unknown(f"sim.{section}.{name}", "sim.base has no such name", name, names)
