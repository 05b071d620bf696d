"""What the columns of a simulator's states and outputs show, where a sensor shows something else.

A line in place of a quantity, such as y = a x + b, is a change of coordinates: d(y)/dt = a f((y - b)/a, u), and a Runge-Kutta
step in y is that in x. So a model whose sensors are such is one of what is read. What is late stays beside the equations:
what was read and what has acted since tell what the state is (`simpel_cli.dynamics.late_readings`).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import casadi

from simulators.coordinates import UNLIMITED, Coordinates
from simulators.expression import Symbol
from simulators.quantity import TIMES, ModelError, check_keys, check_mapping, read_term, read_times, refuse_unknown

KEYS = ("value", *TIMES)
EARLY = "nothing is shown before it happens"

Named = Callable[[Symbol], dict[str, Symbol]]
Line = tuple[Symbol, Symbol]  # scale, bias


def with_sensors(model: Any, nodes: Mapping[str, Any], named: Named) -> Any:
    """Return the model of what its sensors show.

    Args:
        model: `simulators.model.Model`, of the system itself or of what other sensors show.
        nodes: state or output -> {value, lag, delay}.
        named: p -> what the names of parameters stand for.

    Raises:
        ModelError: an unknown name or key; a value that is no line in what it stands for.
    """
    if not nodes:
        return model
    check_mapping("sim.sensors", nodes)
    states, outputs = ([q.name for q in group] for group in (model.states, model.outputs))
    for name, node in nodes.items():
        if name not in (*states, *outputs):
            refuse_unknown(f"sim.sensors.{name}", "is neither a state nor an output", name, [*states, *outputs])
        check_keys(f"sim.sensors.{name}", node, KEYS)
    late = {key: read_times(key, nodes, model.params, model.fixed, "sensors", EARLY) for key in TIMES}
    for key, before in (("delay", model.sensor_delay), ("lag", model.sensor_lag)):
        if both := sorted(before.keys() & late[key].keys()):
            raise ModelError(f"sim.sensors.{both[0]}.{key}: the base has one already; change it there")
    model = replace(model, sensor_delay=model.sensor_delay | late["delay"], sensor_lag=model.sensor_lag | late["lag"])
    values = {name: node["value"] for name, node in nodes.items() if "value" in node}
    if not values:
        return model

    def line(name: str, p: Symbol) -> Line:
        return line_of(f"sim.sensors.{name}.value", values[name], name, named(p), model.symbol)

    def each(names: list[str], rows: Symbol, change: Callable[[Symbol, Line], Symbol], p: Symbol) -> Symbol:
        changed = [change(rows[i], line(name, p)) if name in values else rows[i] for i, name in enumerate(names)]
        return casadi.vertcat(*changed) if changed else rows

    def meant(x: Symbol, p: Symbol) -> Symbol:
        return each(states, x, lambda row, of: (row - of[1]) / of[0], p)

    def shown(x: Symbol, p: Symbol) -> Symbol:
        return each(states, x, lambda row, of: of[0] * row + of[1], p)

    def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return each(states, model.rhs(meant(x, p), u, p), lambda row, of: of[0] * row, p)

    def output(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return each(outputs, model.output(meant(x, p), u, p), lambda row, of: of[0] * row + of[1], p)

    return replace(model, rhs=rhs, output=output) if not values.keys() & set(states) else replace(
        model, rhs=rhs, output=output, coordinates=_seen_through(model, meant, shown),
        limits={} if model.limits.keys() & values.keys() else model.limits,
    )  # fmt: skip


def _seen_through(
    model: Any, meant: Callable[[Symbol, Symbol], Symbol], shown: Callable[[Symbol, Symbol], Symbol]
) -> Coordinates | None:
    """Return the coordinates that a transition still needs: own ones, or the states themselves where these have limits."""
    own = model.coordinates
    if own is not None:
        return own._replace(enter=lambda x, p: own.enter(meant(x, p), p), leave=lambda z, p: shown(own.leave(z, p), p))
    if not model.limits:
        return None
    low, high = (tuple(model.limits.get(q.name, UNLIMITED)[end] for q in model.states) for end in (0, 1))
    return Coordinates(len(model.states), meant, model.rhs, shown, (low, high))


def line_of(path: str, formula: Any, name: str, scope: Mapping[str, Symbol], symbol: Any) -> Line:
    """Return scale and bias of a formula that is a line in a name."""
    own = symbol.sym(name, 1, 1)
    value = read_term(path, formula, dict(scope) | {name: own})
    slope = casadi.jacobian(value, own)
    if casadi.depends_on(slope, own) or slope.is_zero():
        raise ModelError(
            f"{path}: {formula!r} is no line in {name}; what a sensor shows is a factor of it and an offset, which may depend "
            f"on parameters: write e.g. 1.02*{name} + 0.1"
        )
    return slope, casadi.substitute(value, own, symbol(0))
