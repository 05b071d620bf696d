"""States that were not measured and are no speed either: from the rate of a measured state that they drive.

    d(p)/dt = f(p, z, u, phi),   solved for z

with d(p)/dt from a smoothing spline and phi in the middle of its ranges. So the estimate leans on the simulator, which
a speed does not: it is a start for the learning, and is reported as something to look at.

Example: the level z of a tank that empties into another one, whose level p is measured.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Source
from simulators.model import Model

PROBES = 16  # random points at which the rate must grow, or fall, over the whole range of z
LEVELS = 33
HALVINGS = 50


class Drive(NamedTuple):
    """How an unmeasured state shows in the rate of a measured one."""

    hidden: int  # row of z
    seen: int  # row of p
    rising: bool  # f grows with z


class Solved(NamedTuple):
    """The unmeasured state of an episode."""

    values: np.ndarray  # (T,), within its declared range
    at_an_end: float  # share of the rows that no value within the range explains
    sensitivity: float  # median |df/dz|, which divides the noise of the rate


def drive(model: Source, name: str, unmeasured: Collection[str]) -> Drive | None:
    """Find a measured state whose rate tells the unmeasured one: it depends on no other, and always in one direction."""
    if not isinstance(model, Model):
        return None  # a world shows no equations
    names = [q.name for q in model.states]
    z = names.index(name)
    rows, columns = (np.array(index) for index in model.function().jac_sparsity(0, 0).get_triplet())
    rng = np.random.default_rng(0)
    for p, seen in enumerate(names):
        reads = {names[column] for column in columns[rows == p]}
        if seen in unmeasured or reads & set(unmeasured) != {name}:
            continue
        low, high = (np.array([getattr(q, end) for q in model.states]) for end in ("low", "high"))
        states = np.repeat(rng.uniform(low, high, (PROBES, len(names))), LEVELS, axis=0)
        states[:, z] = np.tile(np.linspace(low[z], high[z], LEVELS), PROBES)
        inputs = [np.repeat(rng.uniform(q.low, q.high, PROBES), LEVELS) for q in model.inputs]
        inputs_of_rows = np.stack(inputs, axis=1) if inputs else np.empty((len(states), 0))
        rise = np.diff(_rates(model, states, inputs_of_rows)[p].reshape(PROBES, LEVELS), axis=1)
        if np.all(rise > 0) or np.all(rise < 0):
            return Drive(z, p, bool(rise[0, 0] > 0))
    return None


def solve(model: Model, found: Drive, states: np.ndarray, inputs: np.ndarray, rate: np.ndarray) -> Solved:
    """Solve the rate for the unmeasured state by bisection.

    Args:
        model: the simulator.
        found: which state drives which.
        states: (T, n_states); the column of the unmeasured one is not read.
        inputs: (T, n_inputs).
        rate: d(p)/dt, (T,).
    """
    quantity = model.states[found.hidden]
    low, high = np.full(len(rate), quantity.low), np.full(len(rate), quantity.high)

    def rates(z: np.ndarray) -> np.ndarray:
        trial = states.copy()
        trial[:, found.hidden] = z
        return _rates(model, trial, inputs)[found.seen]

    for _ in range(HALVINGS):
        middle = (low + high) / 2
        below = (rates(middle) < rate) == found.rising
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    values = (low + high) / 2
    width = quantity.high - quantity.low
    slope = (rates(values + 1e-4 * width) - rates(values - 1e-4 * width)) / (2e-4 * width)
    ends = (values - quantity.low < 1e-9 * width) | (quantity.high - values < 1e-9 * width)
    return Solved(values, float(np.mean(ends)), float(np.median(np.abs(slope))))


def _rates(model: Model, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Time derivative of the states at n points, (n_states, n), with parameters in the middle of their ranges."""
    middle = np.array([(q.low + q.high) / 2 for q in model.params])
    everywhere = model.function().map(len(states))
    return np.asarray(everywhere(states.T, inputs.T, np.tile(middle[:, None], (1, len(states))))[0])
