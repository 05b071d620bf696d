"""Where effects can act, read off a model: velocity rows with their positions, first-order rows, kinematic rows."""

from typing import NamedTuple

import casadi
import numpy as np

from simulators.model import Model
from simulators.quantity import HIDDEN, READING

VELOCITIES = ("m/s", "rad/s", "deg/s", "1/min", "rpm")  # units that nothing else than a velocity has
SAME = 1e-9  # of a rate: below, rounding
_FIRST_ORDER = ("level", "temperature", "other")


class Structure(NamedTuple):
    """Roles of a model's states.

    Args:
        kinematic: rates that hold by definition (a position's rate is a velocity; a reading follows; a hidden state does what
            its equation says); no force acts there.
        velocity: rates that forces act on -> the state that this one is the rate of, or None where there is none.
        first_order: all other rates: levels, temperatures, concentrations.
        inferred: state -> what its role was read off, where nothing was declared and it is not first-order.
    """

    kinematic: tuple[str, ...]
    velocity: dict[str, str | None]
    first_order: tuple[str, ...]
    inferred: dict[str, str]

    @property
    def dynamic(self) -> tuple[str, ...]:
        """States whose rate may lack something."""
        return (*self.velocity, *self.first_order)


def structure(model: Model) -> Structure:
    """Read the roles off what is declared; where nothing is, off the right-hand side and the units.

    A rate is kinematic if it is another state itself, or depends on states alone, one of which has its unit. A state is
    a velocity if a kinematic rate depends on it and it has that rate's unit, or if its unit is one of `VELOCITIES`.
    """
    on_x, on_u, on_p = depends(model)
    names, units = [q.name for q in model.states], [_plain(q.unit) for q in model.states]
    identity = _identities(model)
    kinematic: dict[int, int | None] = {}
    for i, q in enumerate(model.states):
        declared = q.role in ("position", READING, HIDDEN)
        if q.role and not declared:
            continue
        source = None
        if q.role not in (READING, HIDDEN) and not on_p[i].any() and not on_u[i].any():
            others = [j for j in np.flatnonzero(on_x[i]) if j != i and units[j]]
            of_rate = [int(j) for j in others if units[j] == _plain(f"{units[i]}/s")]
            source = of_rate[0] if of_rate else identity.get(i)
        if declared or source is not None:
            kinematic[i] = source
    position = {j: i for i, j in kinematic.items() if j is not None and identity.get(i) == j}
    of_position = {j: i for i, j in kinematic.items() if j is not None}
    velocity, first = {}, []
    inferred = {names[i]: f"its rate is {names[j]}" for i, j in kinematic.items() if j is not None}
    for j, q in enumerate(model.states):
        if j in kinematic:
            continue
        if q.role in _FIRST_ORDER or not (q.role or j in of_position or units[j] in VELOCITIES):
            first.append(q.name)
            continue
        velocity[q.name] = names[position[j]] if j in position else None
        inferred[q.name] = f"unit {q.unit}" if units[j] in VELOCITIES else f"the rate of {names[of_position.get(j, j)]}"
    said = {q.name for q in model.states if q.role}
    inferred = {name: why for name, why in inferred.items() if name not in said}
    return Structure(tuple(names[i] for i in kinematic), velocity, tuple(first), inferred)


def drives(model: Model) -> dict[str, tuple[str, ...]]:
    """Return velocity -> the inputs that push it from standstill while the others are 0: a motor does, a steering angle not."""
    function, random = model.function(), np.random.default_rng(0)
    x = np.array([random.uniform(0.5, 1.5) for _ in model.states])
    velocity = structure(model).velocity
    x[[q.name in velocity for q in model.states]] = 0.0
    p = [random.uniform(q.low, q.high) for q in model.params]
    found: dict[str, tuple[str, ...]] = dict.fromkeys(velocity, ())
    still = np.asarray(function(x, np.zeros(len(model.inputs)), p)[0]).ravel()
    for j, q in enumerate(model.inputs):
        if q.name in model.covariates:
            continue
        pushed = np.asarray(
            function(x, np.where(np.arange(len(model.inputs)) == j, q.high or q.low, 0.0), p)[0]
        ).ravel()
        moved = np.abs(pushed - still) > SAME * np.maximum(np.abs(pushed), np.abs(still))
        found |= {
            s.name: (*found[s.name], q.name) for s, m in zip(model.states, moved, strict=True) if m and s.name in found
        }
    return found


def depends(model: Model) -> tuple[np.ndarray, ...]:
    """Return which rates depend on which states, inputs and parameters: a table (states, ...) of each."""
    groups = (model.states, model.inputs, model.params)
    symbols = [casadi.SX.sym(n, len(g), 1) for n, g in zip("xup", groups, strict=True)]
    rates = model.function()(*symbols)[0]
    return tuple(_depends(rates, symbol) for symbol in symbols)


def _depends(rates: casadi.SX, symbol: casadi.SX) -> np.ndarray:
    if symbol.numel() == 0:
        return np.zeros((rates.numel(), 0), bool)
    return np.array(casadi.DM(casadi.jacobian_sparsity(rates, symbol), 1).full(), bool)


def _identities(model: Model) -> dict[int, int]:
    """Rows whose rate is exactly another state."""
    function = model.function()
    random = np.random.default_rng(0)
    sizes = [len(model.states), len(model.inputs), len(model.params)]
    found: dict[int, int] = {}
    points = [[random.uniform(0.5, 1.5, n) for n in sizes] for _ in range(3)]
    rates = [np.asarray(function(*point)[0]).ravel() for point in points]
    for i in range(sizes[0]):
        for j in range(sizes[0]):
            if i != j and all(rate[i] == point[0][j] for rate, point in zip(rates, points, strict=True)):
                found[i] = j
    return found


def _plain(unit: str) -> str:
    return unit.replace(" ", "")
