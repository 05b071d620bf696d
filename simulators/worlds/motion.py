"""How a world or a model moves from row to row, over all episodes at once, and where it is at any time in between.

The motion between rows is integrated here with steps of its own, not by `RK4.follow`: what measurements are made with must
not share the approximations of what learns from them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import casadi
import numpy as np
from scipy.interpolate import CubicHermiteSpline, KroghInterpolator

from simulators.model import TIE, Model, ModelError
from simulators.quantity import HELD, LINEAR, SMOOTH
from simulators.worlds.rk4 import RK4
from simulators.worlds.world import FinerWorld, World

SUBSTEPS = 10  # Runge-Kutta steps per row between rows, at least
PIECES = 16  # straight ones in a row of a smooth input: off by 1/2048 of what it bends in a row
PARABOLA = 3  # rows that one takes


class Course(NamedTuple):
    """How inputs go, each in one piece: (n, m, du) values at the times `since`, s, and slopes from there on."""

    value: np.ndarray
    slope: np.ndarray
    since: np.ndarray

    def piece(self, j: int) -> "Course":
        """Return one of the m, (n, du)."""
        return Course(*(each[:, j] for each in self))

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the inputs (n, ..., du) at the times t (n, ...), s."""
        return self.value + self.slope * (t[..., None] - self.since)


class Inputs(NamedTuple):
    """The inputs as the plant sees them.

    Args:
        times: (n, rows) at which they are given, s, increasing.
        values: (n, rows, du).
        linear: (du,) true: straight from a time to the next; false: held.

    Before the first row the first value was held, after the last the last one is.

    """

    times: np.ndarray
    values: np.ndarray
    linear: np.ndarray

    @classmethod
    def of_rows(cls, times: np.ndarray, values: np.ndarray, words: Sequence[str]) -> "Inputs":
        """Return inputs that are given in rows, `held`, `linear` or `smooth` in between.

        A smooth one is a cubic in each row, with the slopes of polynomials through five rows, drawn in short straight lines.
        """
        moving, rows = np.array([word != HELD for word in words], bool), values.shape[1]
        if SMOOTH not in words or rows < PARABOLA:
            return cls(times, values, moving)
        shares = np.arange(PIECES) / PIECES
        begin, lasts = times[:, :-1, None], np.diff(times)[:, :, None]
        fine = np.concatenate([(begin + shares * lasts).reshape(len(times), -1), times[:, -1:]], axis=1)
        found = np.zeros((*fine.shape, len(words)))
        for k, i in np.ndindex(len(times), len(words)):
            if words[i] == SMOOTH:
                slopes = _slopes(times[k], values[k, :, i])
                found[k, :, i] = CubicHermiteSpline(times[k], values[k, :, i], slopes)(fine[k])
            elif words[i] == LINEAR:
                found[k, :, i] = np.interp(fine[k], times[k], values[k, :, i])
            else:
                found[k, :, i] = np.repeat(values[k, :, i], PIECES)[: fine.shape[1]]
        return cls(fine, found, moving)

    def course(self, t: np.ndarray, late: np.ndarray) -> Course:
        """Return how the inputs go that act at the times t (n, m), s, each `late` (n, du), s, after its row."""
        n, m = t.shape
        row = np.zeros((n, m, late.shape[1]), int)
        for k in range(n):
            for i in range(late.shape[1]):
                row[k, :, i] = np.searchsorted(self.times[k], t[k] - late[k, i], side="right") - 1
        episode, signal = np.arange(n)[:, None, None], np.arange(late.shape[1])
        known, following = np.maximum(row, 0), np.minimum(row + 1, self.times.shape[1] - 1)
        value, begin = self.values[episode, known, signal], self.times[episode, known]
        lasts = self.times[episode, following] - begin
        goes = self.linear & (row >= 0) & (lasts > 0)  # before the first row and after the last all are held
        slope = np.where(goes, self.values[episode, following, signal] - value, 0.0) / np.where(goes, lasts, 1.0)
        return Course(value, slope, begin + late[:, None])

    def at(self, t: np.ndarray, tie: float, late: np.ndarray | None = None) -> np.ndarray:
        """Return the inputs (n, m, du) at the times t (n, m), s, each `late` (n, du), s; a row counts from `tie` s before it.

        None is late: the inputs as they are given.
        """
        return self.course(t + tie, np.zeros((len(t), self.values.shape[2])) if late is None else late).at(t)


def _slopes(t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the slopes at rows of polynomials through five rows; beyond both ends lies the parabola of the last three."""
    step = np.ptp(t) / (len(t) - 1)
    more = step * np.arange(1, 3)
    ends = (t[:PARABOLA], u[:PARABOLA], t[0] - more[::-1]), (t[-PARABOLA:], u[-PARABOLA:], t[-1] + more)
    first, last = (KroghInterpolator(own, values)(at) for own, values, at in ends)
    t, u = np.concatenate([ends[0][2], t, ends[1][2]]), np.concatenate([first, u, last])
    near = np.arange(len(t) - 4)[:, None] + np.arange(5)
    far = (t[near] - t[2:-2, None]) / step
    powers = far[:, None] ** np.arange(5)[None, :, None]
    weights = np.linalg.solve(powers, np.broadcast_to(np.eye(5)[:, 1:2], (len(far), 5, 1)))[..., 0]
    return np.asarray(np.sum(weights * u[near], axis=1) / step)


class Drifting(NamedTuple):
    """Parameters that change within an episode.

    Args:
        begin: (n, dp) at t = 0.
        rate: (dp,) relative change, 1/s.

    """

    begin: np.ndarray
    rate: np.ndarray

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the parameters (n, ..., dp) at the times t (n, ...), s."""
        begin = self.begin.reshape(len(t), *(1,) * (t.ndim - 1), self.begin.shape[1])
        return begin * (1 + self.rate * t[..., None])


def true_values(
    source: Model | World, start: np.ndarray, inputs: Inputs, params: Drifting, times: np.ndarray, cause: str = ""
) -> dict[str, np.ndarray]:
    """Return the true values of states, inputs and outputs, name -> (n, m), at the times (n, m), s, in order.

    Args:
        source: the model or world.
        start: (n, ds) at t = 0.
        inputs: as given.
        params: parameters over time.
        times: not below 0.
        cause: keys of the configuration by which there are times between rows; empty: there are none, the rows are `dt`
            apart, inputs are held and parameters constant.

    Raises:
        ModelError: a state is not finite, or cannot be told at one of the times.

    """
    if isinstance(source, Model) and cause:
        states = of_model(source, start, inputs, params, times)
    else:
        states = of_rows(source, start, inputs.values, params.begin, times, cause)
    given = inputs.at(times, TIE * source.dt)
    arriving = given
    if isinstance(source, Model) and source.delay:
        arriving = inputs.at(times, TIE * source.dt, _delays(source, params.begin))
    points = [each.reshape(times.size, each.shape[2]) for each in (states, given, params.at(times), arriving)]
    return {name: values.reshape(times.shape) for name, values in named(source, *points).items()}


def named(
    source: Model | World,
    states: np.ndarray,
    inputs: np.ndarray,
    params: np.ndarray,
    arriving: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Return the true values of states, inputs and outputs at n points, name -> (n,).

    Args:
        source: the model or world.
        states: (n, ds).
        inputs: as given, (n, du).
        params: (n, dp).
        arriving: inputs as they act at these points, of which a model delays some, (n, du); None: none is late.

    """
    found = {q.name: states[:, i] for i, q in enumerate(source.states)}
    found |= {q.name: inputs[:, i] for i, q in enumerate(source.inputs)}
    if isinstance(source, Model) and source.outputs:
        outputs = RK4(source).measure(states, inputs if arriving is None else arriving, params)
        found |= {q.name: outputs[:, i] for i, q in enumerate(source.outputs)}
    return found


def on_rows(source: Model | World, start: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
    """Follow n episodes, `dt` from row to row, inputs held in between.

    Args:
        source: the model or world.
        start: (n, ds) states in the first row.
        inputs: (n, rows, du); before the first row the first one was held.
        params: (n, dp).

    Returns:
        The states in every row, (n, rows, ds), not wrapped.

    Raises:
        ModelError: a state is not finite.

    """
    n, rows, _ = inputs.shape
    states = np.zeros((n, rows, len(source.states)))
    states[:, 0] = start
    model = RK4(source) if isinstance(source, Model) else None
    past = model.past(params) if model is not None else 0
    given = np.concatenate([np.repeat(inputs[:, :1], past, axis=1), inputs], axis=1)
    for j in range(1, rows):
        if model is not None:
            states[:, j] = model.follow(states[:, j - 1], given[:, j - 1 : j + past], params)
        elif not isinstance(source, Model):
            states[:, j] = source.step(states[:, j - 1], inputs[:, j - 1], params)
        check_finite(source, states[:, j], j * source.dt)
    return states


def of_rows(
    source: Model | World, start: np.ndarray, inputs: np.ndarray, params: np.ndarray, times: np.ndarray, cause: str
) -> np.ndarray:
    """Return the states (n, m, ds) at the times (n, m), s, from those of the rows, `dt` apart.

    Raises:
        ModelError: a world is asked between rows (`cause` says by which keys), and cannot answer there.

    """
    states = on_rows(source, start, inputs, params)
    row = np.floor(times / source.dt + TIE).astype(int)
    after = times - row * source.dt
    found = np.take_along_axis(states, row[:, :, None], axis=1)
    keys = np.round(after / (TIE * source.dt)).astype(np.int64)  # differences of rounding are no times of their own
    for key in np.unique(keys[keys > 1]):
        k, m = np.nonzero(keys == key)
        finer = _shorter(source, float(after[k[0], m[0]]), cause)
        found[k, m] = finer.step(states[k, row[k, m]], inputs[k, row[k, m]], params[k])
        for each in np.unique(m):
            check_finite(source, found[:, each], float(times[:, each].max()))
    return found


def _shorter(source: Model | World, duration: float, cause: str) -> World:
    if isinstance(source, Model) or not isinstance(source, FinerWorld):
        raise ModelError(
            f"{cause}: {source.name} answers every {source.dt:g} s only; give a whole number of them, or leave it out"
        )
    try:
        return source.shorter(duration)
    except ModelError as error:
        raise ModelError(f"{cause}: {error}") from error


def of_model(model: Model, start: np.ndarray, inputs: Inputs, params: Drifting, times: np.ndarray) -> np.ndarray:
    """Integrate a model to any times: between two instants at which an input arrives everything is smooth.

    Args:
        model: the symbolic model.
        start: (n, dx) at t = 0.
        inputs: as given; a delay of the model makes them late.
        params: parameters over time.
        times: (n, m) in order, s, not below 0.

    Returns:
        The states, (n, m, dx), not wrapped.

    Raises:
        ModelError: a state is not finite, or an input has a lag.

    """
    RK4(model)  # refuses what has no finite past
    flow, late = _Flow.of(model, len(start)), _delays(model, params.begin)
    edges = _edges(inputs, late, times)
    # the middle says which row's inputs act, free of the rounding at the ends
    courses = inputs.course((edges[:, :-1] + edges[:, 1:]) / 2, late)
    z = flow.enter(start, params.at(edges[:, 0]))
    path = np.empty((*edges.shape, z.shape[1]))
    path[:, 0] = z
    longest = model.dt / max(model.substeps, SUBSTEPS)
    for j in range(edges.shape[1] - 1):
        begin, length = edges[:, j], edges[:, j + 1] - edges[:, j]
        if length.any():
            steps = max(1, math.ceil(length.max() / longest - TIE))
            for s in range(steps):
                z = flow.step(z, courses.piece(j), params, begin + s * length / steps, length / steps)
            if not np.isfinite(z).all():
                check_finite(model, flow.leave(z, params.at(edges[:, j + 1])), edges[:, j + 1].max())
        path[:, j + 1] = z
    reached = np.stack([np.searchsorted(own, asked) for own, asked in zip(edges, times, strict=True)])
    found = [
        flow.leave(path[np.arange(len(path)), reached[:, m]], params.at(times[:, m])) for m in range(times.shape[1])
    ]
    return np.stack(found, axis=1)


def _edges(inputs: Inputs, late: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the instants (n, e), from t = 0, between which everything is smooth, the times (n, m) among them."""
    begin = np.zeros((len(times), 1))
    arrivals = [inputs.times + each[:, None] for each in np.unique(late, axis=1).T]  # of inputs equally late once
    arriving = np.clip(np.concatenate([begin, *arrivals], axis=1), 0.0, times[:, -1:])
    return np.sort(np.concatenate([arriving, times], axis=1), axis=1)


def _delays(model: Model, params: np.ndarray) -> np.ndarray:
    """Return how late every input acts in every episode, s, (n, du)."""
    names = [q.name for q in model.params]
    late = np.zeros((len(params), len(model.inputs)))
    for i, q in enumerate(model.inputs):
        value = model.delay.get(q.name, 0.0)
        own = model.fixed.get(value, value) if isinstance(value, str) else value
        late[:, i] = params[:, names.index(own)] if isinstance(own, str) else own
    return np.maximum(late, 0.0)  # a normal prior has draws beyond its range


class _Flow(NamedTuple):
    """The equations of a model, for n episodes at once."""

    functions: dict[str, casadi.Function]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, model: Model, n: int) -> "_Flow":
        flow = model.flow()
        given = {"enter": flow.enter, "rhs": flow.rhs, "leave": flow.leave}
        return cls({k: f.map(n) for k, f in given.items() if f is not None}, np.array(flow.low), np.array(flow.high))

    def enter(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        return self._call("enter", x, p) if "enter" in self.functions else np.asarray(x, float)

    def leave(self, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        return self._call("leave", z, p) if "leave" in self.functions else z

    def step(self, z: np.ndarray, course: Course, params: Drifting, t: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Go one step of the classical Runge-Kutta method from the times t (n,), s, with lengths h (n,), s."""
        middle, end, length = t + h / 2, t + h, h[:, None]
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused afterwards
            k1 = self._call("rhs", z, course.at(t), params.at(t))
            k2 = self._call("rhs", z + length / 2 * k1, course.at(middle), params.at(middle))
            k3 = self._call("rhs", z + length / 2 * k2, course.at(middle), params.at(middle))
            k4 = self._call("rhs", z + length * k3, course.at(end), params.at(end))
            after = z + length / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return np.clip(after, self.low, self.high)

    def _call(self, name: str, *arguments: np.ndarray) -> np.ndarray:
        found: np.ndarray = self.functions[name](*(casadi.DM(a.T) for a in arguments)).full().T
        return found


def check_finite(source: Model | World, states: np.ndarray, t: float) -> None:
    """Refuse states (n, ds) at t, s, that are not finite."""
    bad = np.argwhere(~np.isfinite(states))
    if len(bad):
        k, i = bad[0]
        raise ModelError(
            f"simulation: {source.states[i].name} of {source.name} is {states[k, i]} at t = {t:g} s of "
            f"episode {k}; narrow simulation.initial or the inputs, or give {source.name} smaller steps"
        )
