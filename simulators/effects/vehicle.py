"""Whether a model is a vehicle that is steered in the plane, and how its forces are expressed along its own axes.

    long = vx cos(theta) + vy sin(theta),    lat = vy cos(theta) - vx sin(theta),    yaw = d(theta)/dt
    d(long)/dt = d(vx)/dt cos(theta) + d(vy)/dt sin(theta) + yaw lat
    d(lat)/dt = d(vy)/dt cos(theta) - d(vx)/dt sin(theta) - yaw long

The terms in yaw are there because the axes turn; a force along an axis changes one of long, lat and yaw and leaves the rest.
"""

from collections.abc import Iterator
from itertools import permutations
from typing import NamedTuple

import casadi
import numpy as np

from simulators.effects.structure import Structure, depends, structure
from simulators.model import Model

PARTS = ("long", "lat", "yaw", "heading")  # accelerations along, across and about; rate of a heading without inertia
TURN = 0.7  # rad, by which a vehicle is turned in a test
SAME = 1e-9


class Vehicle(NamedTuple):
    """A vehicle in the plane.

    Args:
        names: long, lat, yaw, heading, and rate_long, rate_lat, rate_yaw for what the model has of them (its own rates) ->
            expressions in states and `rate_STATE`, the model's own rate of a state.
        parts: part of PARTS that the model has -> state -> factor with which the part enters its rate.
    """

    names: dict[str, str]
    parts: dict[str, dict[str, str]]


def vehicle(model: Model) -> Vehicle | None:
    """Return the model as a vehicle: world-frame or body-frame velocities, or a single speed; None if it is none.

    A vehicle has a heading whose rate, or whose rate's rate, depends on a speed and on an input. With two velocities, a
    turn of the whole vehicle must turn its motion and change nothing else.
    """
    roles = structure(model)
    units = {q.name: q.unit.replace(" ", "") for q in model.states}
    angles = {q.name for q in model.states if q.periodic or q.unit == "rad"}
    speeds = [name for name in roles.velocity if units[name] == "m/s"]
    if len(speeds) == 1:
        headings = [n for n in roles.first_order if n in angles and _is_steered(model, n, speeds)]
        return _with_one_speed(speeds[0], headings[0]) if len(headings) == 1 else None
    turning = [
        (s, v)
        for v, s in roles.velocity.items()
        if s in angles and units[v] == "rad/s" and _is_steered(model, v, speeds)
    ]
    if len(speeds) != 2 or len(turning) != 1:
        return None
    (heading, yaw) = turning[0]
    of_position = {s: v for v, s in roles.velocity.items() if v in speeds and s is not None}
    for first, second in permutations(speeds):
        if len(of_position) == 2 and _turns_as_one(model, first, second, heading):
            return _in_the_world(first, second, heading, yaw)
        if not of_position and _moves_along(model, roles, units, first, second, heading):
            return _in_the_body(first, second, heading, yaw)
    return None


def _is_steered(model: Model, name: str, speeds: list[str]) -> bool:
    on_states, on_inputs, _ = depends(model)
    row = [q.name for q in model.states].index(name)
    by_speed = any(on_states[row][j] for j, q in enumerate(model.states) if q.name in speeds)
    return bool(by_speed and on_inputs[row].any())


def _points(model: Model) -> Iterator[tuple[dict[str, float], list[np.ndarray]]]:
    """Yield a few states, with inputs and parameters."""
    random = np.random.default_rng(0)
    for _ in range(3):
        x = {q.name: float(random.uniform(0.5, 1.5)) for q in model.states}
        yield x, [random.uniform(0.5, 1.5, len(group)) for group in (model.inputs, model.params)]


def _rates(function: casadi.Function, x: dict[str, float], rest: list[np.ndarray]) -> dict[str, float]:
    return dict(zip(x, np.asarray(function(list(x.values()), *rest)[0]).ravel(), strict=True))


def _turns_as_one(model: Model, first: str, second: str, heading: str) -> bool:
    function, c, s = model.function(), np.cos(TURN), np.sin(TURN)
    for x, rest in _points(model):
        turned = {first: c * x[first] - s * x[second], second: s * x[first] + c * x[second], heading: x[heading] + TURN}
        old, new = _rates(function, x, rest), _rates(function, x | turned, rest)
        wanted = {first: c * old[first] - s * old[second], second: s * old[first] + c * old[second]}
        own = {name: rate for name, rate in old.items() if model.states[list(x).index(name)].unit != "m"}
        if not all(np.isclose(new[n], v, rtol=SAME, atol=SAME) for n, v in (own | wanted).items()):
            return False
    return True


def _moves_along(model: Model, roles: Structure, units: dict[str, str], first: str, second: str, heading: str) -> bool:
    function = model.function()
    for positions in permutations([name for name in roles.kinematic if units[name] == "m"], 2):
        found = []
        for x, rest in _points(model):
            rates, (c, s) = _rates(function, x, rest), (np.cos(x[heading]), np.sin(x[heading]))
            along = c * x[first] - s * x[second], s * x[first] + c * x[second]
            found.append(np.allclose([rates[p] for p in positions], along, rtol=SAME))
        if all(found):
            return True
    return False


def _in_the_world(vx: str, vy: str, heading: str, yaw: str) -> Vehicle:
    c, s = f"cos({heading})", f"sin({heading})"
    long, lat = f"({vx}*{c} + {vy}*{s})", f"({vy}*{c} - {vx}*{s})"
    names = {
        "long": long, "lat": lat, "yaw": yaw, "heading": heading,
        "rate_long": f"(rate_{vx}*{c} + rate_{vy}*{s} + {yaw}*{lat})",
        "rate_lat": f"(rate_{vy}*{c} - rate_{vx}*{s} - {yaw}*{long})",
        "rate_yaw": f"rate_{yaw}",
    }  # fmt: skip
    return Vehicle(names, {"long": {vx: c, vy: s}, "lat": {vx: f"-{s}", vy: c}, "yaw": {yaw: "1"}})


def _in_the_body(long: str, lat: str, heading: str, yaw: str) -> Vehicle:
    names = {
        "long": long, "lat": lat, "yaw": yaw, "heading": heading,
        "rate_long": f"rate_{long}", "rate_lat": f"rate_{lat}", "rate_yaw": f"rate_{yaw}",
    }  # fmt: skip
    return Vehicle(names, {"long": {long: "1"}, "lat": {lat: "1"}, "yaw": {yaw: "1"}})


def _with_one_speed(speed: str, heading: str) -> Vehicle:
    names = {
        "long": speed, "lat": "0", "yaw": f"rate_{heading}", "heading": heading, "rate_long": f"rate_{speed}", "rate_lat": "0"
    }  # fmt: skip
    return Vehicle(names, {"long": {speed: "1"}, "heading": {heading: "1"}})
