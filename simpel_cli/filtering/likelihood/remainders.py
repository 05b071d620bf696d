"""What a simulation leaves of the measurements: in every channel a remainder with a memory.

    y_k = h(x_k, u_k; p) + o_k + r_k,    do = -rate o dt + q dW,    dx = f(x, u; p) dt

No process noise acts on the states, so that a window is one simulation from a start that is estimated, as in the output
error method, and no error ahead is forgiven; the remainder says how far and how long the simulation is off, so that its many
rows are not taken for as many witnesses. Both this and process noise are likelihoods of the same rows: the one asks what the
model is worth as a simulator, the other what it is worth one row ahead.

Reference: Kennedy and O'Hagan (2001), Bayesian calibration of computer models, eq. 5 (the discrepancy); Ljung (1999), System
identification, 4.2 and 7.2 (output error, coloured noise); Uhlenbeck and Ornstein (1930).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.data.recording import Episode
from simulators.effects import Scales
from simulators.expression import Symbol
from simulators.model import Model, Quantity

SHARE = 0.3  # of a channel's magnitude, which a remainder may have
FASTEST = 3.0  # rows in which a remainder is forgotten at the earliest: faster is noise of the sensor
SLOWEST = 1.0  # episodes in which it is forgotten at the latest


class Remainders(NamedTuple):
    """A model whose channels have remainders.

    Args:
        model: the simulator with one state and one rate of forgetting, 1/s, more per channel.
        scales: with theirs.
        states: channel -> its state.
    """

    model: Model
    scales: Scales
    states: dict[str, str]


def remainders_of(
    model: Model, measured: Sequence[str], episodes: Sequence[Episode], outputs: Sequence[str], scales: Scales
) -> Remainders:
    """Give every measured channel of a simulator a remainder.

    Args:
        model: the simulator.
        measured: names of its channels.
        episodes: of the measurements.
        outputs: names of the columns of `Episode.outputs`.
        scales: of the simulator.
    """
    names = {name: f"remainder_{name}" for name in measured}
    units = {q.name: q.unit for q in (*model.states, *model.outputs)}
    longest = max(len(e.time) for e in episodes) * model.dt * SLOWEST
    slow, fast = 1 / max(longest, 2 * FASTEST * model.dt), 1 / (FASTEST * model.dt)
    states = tuple(
        Quantity(names[n], units[n], -SHARE * scales.size[n], SHARE * scales.size[n], role="other") for n in measured
    )
    rates = tuple(Quantity(f"forgetting_{n}", "1/s", slow, fast, prior="lognormal") for n in measured)
    nx, n_p = len(model.states), len(model.params)

    def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return casadi.vertcat(model.rhs(x[:nx], u, p[:n_p]), -p[n_p : n_p + len(rates)] * x[nx:])

    def output(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return model.output(x[:nx], u, p[:n_p])

    extended = replace(
        model,
        states=(*model.states, *states),
        params=(*model.params, *rates),
        rhs=rhs,
        output=output,
        coordinates=None,
    )
    size = {names[n]: SHARE * scales.size[n] for n in measured}
    rate = {names[n]: _rate(model, n, episodes, outputs) for n in measured}
    return Remainders(extended, scales._replace(size=scales.size | size, rate=scales.rate | rate), names)


def _rate(model: Model, name: str, episodes: Sequence[Episode], outputs: Sequence[str]) -> float:
    """Return the typical rate of a channel, in its unit per second."""
    states = [q.name for q in model.states]
    columns = [
        e.states[:, states.index(name)] if name in states else e.outputs[:, list(outputs).index(name)] for e in episodes
    ]
    steps = [
        (np.diff(values[there]), np.diff(there))
        for values in columns
        for there in [np.flatnonzero(np.isfinite(values))]
    ]
    rise, rows = (np.concatenate(part) for part in zip(*steps, strict=True))
    if any(q.name == name and q.periodic for q in model.states):
        rise = (rise + np.pi) % (2 * np.pi) - np.pi
    return max(float(np.std(rise / (rows * model.dt))) if len(rise) else 0.0, 1e-12)
