"""Sensors of a declared simulator: what is read in place of an output, with scale, bias, limits, a lag and a delay."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import casadi

from simulators.expression import CONSTANTS, Symbol
from simulators.quantity import (
    READING,
    ModelError,
    Quantity,
    check_keys,
    read_expression,
    read_limits,
    read_number,
    read_range,
    read_term,
    read_unit,
    refuse_unknown,
)

KEYS = ("unit", "expression", "scale", "bias", "saturates", "lag", "range", "delay")
LEAST_LAG = 0.5  # Runge-Kutta steps: a third is where they begin to diverge


class Sensor(NamedTuple):
    """An output and how it is read: scale*expression + bias, within its ends, later if there is a lag or a delay.

    Args:
        quantity: name, unit, and the range of a lagging one.
        path: key path, for messages.
        expression: what is measured.
        scale, bias: a number or the name of a parameter.
        ends: lowest and highest reading.
        lag: time constant, s, or the name of a parameter; None: the reading follows at once.
        delay: s, how long a reading takes to the record. It changes no equation: measurements are read for it.
    """

    quantity: Quantity
    path: str
    expression: Any
    scale: float | str
    bias: float | str
    ends: tuple[float, float]
    lag: float | str | None
    delay: float

    @property
    def saturates(self) -> bool:
        """Whether the reading has an end."""
        return any(map(math.isfinite, self.ends))

    def target(self, known: Mapping[str, Symbol]) -> Symbol:
        """Return what is read at once, or what a lagging reading goes to: that is clipped later, as it is measured."""
        value = read_term(self.path, self.expression, known)
        if self.scale != 1:
            value = _value(self.scale, known) * value
        if self.bias != 0:
            value = value + _value(self.bias, known)
        low, high = self.ends if self.lag is None else (-math.inf, math.inf)
        value = casadi.fmax(value, low) if math.isfinite(low) else value
        return casadi.fmin(value, high) if math.isfinite(high) else value


def read_sensors(
    nodes: Mapping[str, Any], parameters: Iterable[str], least: Mapping[str, float], step: float
) -> dict[str, Sensor]:
    """Read `outputs`: an expression, or {unit, expression, scale, bias, saturates, lag, range, delay}.

    Args:
        nodes: by name.
        parameters: names that may stand for a number.
        least: of these, the smallest value where it is known.
        step: Runge-Kutta step, s.
    """
    return {
        name: _read(f"sim.outputs.{name}", name, node, list(parameters), least, step) for name, node in nodes.items()
    }


def with_lagging_readings(model: Any, lags: Mapping[str, Any]) -> Any:
    """Return a model in which some outputs are states that follow what they were.

    Args:
        model: `simulators.model.Model`.
        lags: output, with its range, -> (x, u, p) -> its time constant.
    """
    names = [q.name for q in model.outputs]
    late, prompt = [i for i, n in enumerate(names) if n in lags], [i for i, n in enumerate(names) if n not in lags]
    if not late:
        return model
    size = len(model.states)

    def follow(x: Symbol, z: Symbol, u: Symbol, p: Symbol) -> list[Symbol]:
        targets = model.output(x, u, p)
        return [(targets[i] - z[row]) / lags[names[i]](x, u, p) for row, i in enumerate(late)]

    def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        own = x[:size]
        return casadi.vertcat(model.rhs(own, u, p), *follow(own, x[size:], u, p))

    def output(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        readings = model.output(x[:size], u, p)
        return readings[prompt] if prompt else model.symbol(0, 1)

    coordinates = own = model.coordinates
    if own is not None:
        inside = own.size

        def own_rhs(z: Symbol, u: Symbol, p: Symbol) -> Symbol:
            x = own.leave(z[:inside], p)
            return casadi.vertcat(own.rhs(z[:inside], u, p), *follow(x, z[inside:], u, p))

        coordinates = own._replace(
            size=inside + len(late),
            enter=lambda x, p: casadi.vertcat(own.enter(x[:size], p), x[size:]),
            rhs=own_rhs,
            leave=lambda z, p: casadi.vertcat(own.leave(z[:inside], p), z[inside:]),
        )
    return replace(
        model,
        states=(*model.states, *(model.outputs[i]._replace(role=READING) for i in late)),
        outputs=tuple(model.outputs[i] for i in prompt),
        rhs=rhs,
        output=output,
        coordinates=coordinates,
    )


def _read(path: str, name: str, node: Any, parameters: list[str], least: Mapping[str, float], step: float) -> Sensor:
    own = node if isinstance(node, Mapping) else {}
    check_keys(path, own, KEYS)
    scale, bias = (_number_or_name(path, own, key, start, parameters) for key, start in (("scale", 1.0), ("bias", 0.0)))
    ends = read_limits(path, own, "saturates") if "saturates" in own else (-math.inf, math.inf)
    lag = None
    span = (math.nan, math.nan)
    if "lag" in own:
        lag = _number_or_name(path, own, "lag", 0.0, parameters)
        _check_lag(f"{path}.lag", lag if isinstance(lag, float) else least.get(lag, math.inf), step)
        if "range" not in own:
            raise ModelError(f"{path}: no range; a lagging reading is a state of its own: add `range: [low, high]`")
        span = read_range(path, own)
    elif "range" in own:
        raise ModelError(f"{path}.range: an output without a lag is no state and has no range; leave it out")
    quantity = Quantity(name, read_unit(path, own), *span)
    return Sensor(
        quantity, path, read_expression(path, node), scale, bias, ends, lag, _read_delay(f"{path}.delay", name, own)
    )


def _read_delay(path: str, name: str, node: Mapping[str, Any]) -> float:
    given = node.get("delay", 0.0)
    if isinstance(given, str) and given.isidentifier() and given not in CONSTANTS:
        raise ModelError(
            f"{path}: {given!r} is no number; give the delay of the sensor in s. If it is not known, leave it out and give "
            f"its range to `simpel discover`: data.latency: {{{name}: [low, high]}}"
        )
    seconds = read_number(path, given)
    if seconds < 0:
        raise ModelError(
            f"{path}: got {seconds:g} s; it is how late a value is recorded, 0 or more. Leave it out where none is"
        )
    return seconds


def _number_or_name(path: str, node: Mapping[str, Any], key: str, start: float, parameters: list[str]) -> float | str:
    value = node.get(key, start)
    if isinstance(value, str) and value.isidentifier() and value not in CONSTANTS:
        if value not in parameters:
            refuse_unknown(f"{path}.{key}", f"{value!r} is neither a number nor a parameter", value, parameters)
        return value
    return read_number(f"{path}.{key}", value)


def _check_lag(path: str, seconds: float, step: float) -> None:
    if seconds <= 0:
        raise ModelError(f"{path}: {seconds:g} s is not allowed; give a positive time constant, or leave lag out")
    if seconds < LEAST_LAG * step:
        raise ModelError(
            f"{path}: {seconds:g} s is shorter than half a Runge-Kutta step (dt/substeps = {step:g} s), with which it cannot "
            f"be integrated; make substeps {math.ceil(LEAST_LAG * step / seconds)} times as many, or leave lag out"
        )


def _value(given: float | str, known: Mapping[str, Symbol]) -> Symbol:
    return known[given] if isinstance(given, str) else given
