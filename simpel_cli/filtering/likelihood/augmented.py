"""One model that carries every candidate effect at every place, each switched off at its neutral value.

A compile takes seconds and there are dozens of candidates: so one program is compiled for all of them, and a fit chooses
by which parameters it moves.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import casadi
import numpy as np

from simulators.effects import Structure, Term, stores_of, structure, with_stores
from simulators.effects.term import DELAY, LAG, ON_INPUT, OPERATORS, PARAMETER, SENSOR, SENSOR_DELAY, SENSOR_LAG
from simulators.expression import parse
from simulators.model import Model, Quantity


class Augmented(NamedTuple):
    """A model with candidate terms.

    Args:
        model: the simulator as it was, with the states that terms bring along.
        terms: candidates.
        measured: names of the measured states and outputs, the rows of a measurement.
        function: CasADi function (x, u, p) -> (d(x)/dt, measured); p: parameters of the model, then of all effects,
            then all constants.
        params: the rows of p, those of each effect followed by its groups'; those of constants have one value for range.
        neutral: (dp,) values at which every term is switched off (the model's own parameters: middle of their prior).
        operators: kind -> (index of the signal, row of p) for delays, lags and plays, of the model and of the terms.
        own_delay: (nu) known delays of the model, s.
        own_lag: (nu) known lags, s.
        own_late: (ny) known delays of the sensors, s, and (ny) known lags.
        roles: of the states.
        remainders: states that are added to what sensors read; where there are some, process noise acts on them alone.
    """

    model: Model
    terms: tuple[Term, ...]
    measured: tuple[str, ...]
    function: casadi.Function
    params: tuple[Quantity, ...]
    neutral: np.ndarray
    operators: dict[str, tuple[tuple[int, int], ...]]
    own_delay: tuple[float, ...]
    own_lag: tuple[float, ...]
    own_late: tuple[tuple[float, ...], tuple[float, ...]]
    roles: Structure
    remainders: tuple[str, ...] = ()

    @property
    def driven(self) -> tuple[int, ...]:
        """Rows of the state that process noise acts on."""
        names = self.remainders or self.roles.dynamic
        return tuple(i for i, q in enumerate(self.model.states) if q.name in names)

    def rows(self, term: Term) -> list[int]:
        """Rows of p that belong to a term."""
        names = [q.name for q in self.params]
        return [names.index(k.name) for k in term.parameters]

    def spreads(self, term: Term) -> dict[int, list[int]]:
        """Rows of p of the spreads of a term's groups, and of what the groups are; the last group was never seen."""
        names = [q.name for q in self.params]
        return {names.index(g.spread.name): [names.index(q.name) for q in g.members] for g in term.groupings}


def augment(
    model: Model, terms: Sequence[Term], measured: Sequence[str], remainders: Mapping[str, str] | None = None
) -> Augmented:
    """Attach every term to the model.

    Args:
        model: the simulator.
        terms: candidates.
        measured: names of the measured states and outputs.
        remainders: measured channel -> state that is added to what its sensor reads (see `remainders`).
    """
    remainders, model = remainders or {}, with_stores(model, stores_of(terms))
    params = [*model.params]
    neutral = [centre(q) for q in model.params]
    for term in terms:
        for parameter in term.parameters:
            params.append(
                Quantity(parameter.name, parameter.unit, parameter.low, parameter.high, prior=parameter.prior)
            )
            neutral.append(parameter.neutral)
        for grouping in term.groupings:
            params += grouping.own
            neutral += [0.0] * len(grouping.own)
    for name, value in dict(c for term in terms for c in term.constants).items():
        params.append(Quantity(name, "1", value, value))
        neutral.append(value)
    x = model.symbol.sym("x", len(model.states), 1)
    u = model.symbol.sym("u", len(model.inputs), 1)
    p = model.symbol.sym("p", len(params), 1)
    names: dict[str, Any] = {name: model.symbol(value) for name, value in model.fixed.items()}
    names |= {q.name: p[i] for i, q in enumerate(params)}
    names |= {q.name: x[i] for i, q in enumerate(model.states)}
    names |= {q.name: u[j] for j, q in enumerate(model.inputs)}
    for grouping in (g for term in terms for g in term.groupings):
        names[grouping.parameter] = grouping.value(names)
    own, columns = p[: len(model.params)], [q.name for q in params]
    for term in (t for t in terms if t.kind == PARAMETER):
        names[term.acts_on] += parse(term.expression, names, model.symbol)
        if term.acts_on in columns[: len(model.params)]:
            own[columns.index(term.acts_on)] = names[term.acts_on]
    given = [u[j] for j in range(len(model.inputs))]
    for j, q in enumerate(model.inputs):
        for term in terms:
            if q.name in term.inputs:
                given[j] = parse(term.inputs[q.name], names | {q.name: given[j]}, model.symbol)
    effective = casadi.vertcat(*given) if given else model.symbol(0, 1)
    names |= {q.name: given[j] for j, q in enumerate(model.inputs)}
    base = model.rhs(x, effective, own)
    rates = [base[i] for i in range(len(model.states))]
    own_rates = {f"rate_{q.name}": base[i] for i, q in enumerate(model.states)}
    for i, q in enumerate(model.states):
        for term in terms:
            if q.name in term.rates:
                known = names | (own_rates if term.several else {"rate": base[i]})
                rates[i] += parse(term.rates[q.name], known, model.symbol)
    outputs = model.output(x, effective, own)
    values = {q.name: x[i] for i, q in enumerate(model.states)}
    values |= {q.name: outputs[i] for i, q in enumerate(model.outputs)}
    channels = []
    for name in measured:
        value = values[name]
        for term in terms:
            if term.kind == SENSOR and term.acts_on == name:
                value = parse(term.expression, names | {name: value}, model.symbol)
        channels.append(value + names[remainders[name]] if name in remainders else value)
    function = casadi.Function(
        f"{model.name}_augmented",
        [x, u, p],
        [casadi.vertcat(*rates) if rates else model.symbol(0, 1), casadi.vertcat(*channels)],
        ["x", "u", "p"],
        ["dx", "y"],
    )
    operators: dict[str, tuple[tuple[int, int], ...]] = {}
    for kind in OPERATORS:
        signals = [q.name for q in model.inputs] if kind in ON_INPUT else [*measured]
        operators[kind] = tuple(
            (signals.index(t.acts_on), columns.index(t.parameters[0].name)) for t in terms if t.kind == kind
        )
    constant: dict[str, tuple[float, ...]] = {}
    driven = tuple(q.name for q in model.inputs)
    for kind, times, late in (
        (DELAY, model.delay, driven),
        (LAG, model.lag, driven),
        (SENSOR_DELAY, model.sensor_delay, measured),
        (SENSOR_LAG, model.sensor_lag, measured),
    ):
        each = [times.get(name, 0.0) for name in late]
        operators[kind] += tuple((j, columns.index(v)) for j, v in enumerate(each) if v in columns)
        constant[kind] = tuple(0.0 if v in columns else float(model.fixed.get(str(v), v)) for v in each)
    return Augmented(
        model, tuple(terms), tuple(measured), function, tuple(params), np.array(neutral), operators, constant[DELAY],
        constant[LAG], (constant[SENSOR_DELAY], constant[SENSOR_LAG]), structure(model), tuple(remainders.values()),
    )  # fmt: skip


def centre(q: Quantity) -> float:
    """Middle of a prior."""
    return float(np.sqrt(q.low * q.high)) if q.prior == "lognormal" else (q.low + q.high) / 2
