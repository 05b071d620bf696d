"""States and outputs as late sensors show them, and states from what such sensors showed, for one point.

A delay d and a lag tau act together as exp(-d s)/(1 + tau s). Along a smooth motion that is, to third order,

    y = c - m_1(d) c' + m_2(d) c'' - m_3(d) c''',    m_n(d) = sum over i <= n of d^i tau^(n-i)/i!,    c: what a prompt one shows

which holds while d and tau are short against the motion (the next term is about tau^4 times the fourth derivative). Inputs
are held over an integration step, so c' jumps between steps, and with it c'' and c''': at the rows, and within one where an
input is late itself. A jump J_n of the n-th derivative at age a adds what the motion since then does not show: of the time
before the jump that is seen, d - a and what the lag adds,

    -(-1)^n J_n m_n(d - a)  where the delay reaches behind it,    -(-1)^n J_n tau^n exp((d - a)/tau)  where d <= a.

What y says of the state is solved for by Newton's method with one slope: exact in one step for a linear system.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from simpel_cli.dynamics.arriving import values_of
from simpel_cli.dynamics.casadi_jax import to_jax
from simulators.model import Model

JUMPS = 4  # rows that are looked back on
ORDERS = 3  # of the series
STEPS = 3  # of Newton's method

Point = Float[Array, " dx"]
Rows = Float[Array, "R S K du"]  # inputs of the substeps of rows, the latest row last
Whole = Callable[..., tuple[Array, ...]]  # (x (dx,), u (du,), p (dp,)) -> d(x)/dt (dx,), outputs (dy,)


class Late(NamedTuple):
    """The late sensors of a model.

    Args:
        whole: (x, u, p) -> (d(x)/dt, outputs), of prompt sensors.
        times: p -> delay and lag of every state and output, s, (dx + dy,) each.
        states: rows of the late states.
        dt: distance of rows, s.
        substeps: per row.
        driven: whether there are inputs.
        late_inputs: whether these may arrive within a row.
    """

    whole: Whole
    times: Callable[[Array], tuple[Array, Array]]
    states: tuple[int, ...]
    dt: float
    substeps: int
    driven: bool
    late_inputs: bool

    def behind(
        self, x: Point, rows: Rows, phi: Float[Array, " dp"], now: Float[Array, " du"] | None = None
    ) -> Float[Array, " n"]:
        """Return what the sensors of states and outputs show at the end of rows, over what prompt ones would, (dx + dy,).

        Args:
            x: states, as prompt sensors show them.
            rows: inputs that acted until then.
            phi: parameters.
            now: inputs that act from then on, which outputs follow at once; None: outputs do not matter.
        """
        d, tau = self.times(phi)

        def along(way: Point) -> Array:
            """Return the change of what is shown along a change of the states."""
            if now is None:
                return jnp.concatenate([way, jnp.zeros(len(d) - len(way), way.dtype)])
            return jnp.concatenate([way, jax.jvp(lambda x: self.whole(x, now, phi)[1], (x,), (way,))[1]])

        def rate(x: Point, u: Float[Array, " du"]) -> Point:
            return self.whole(x, u, phi)[0]

        def motion(u: Float[Array, "K du"], at: int) -> Float[Array, "orders n"]:
            """Return the first derivatives of c at the beginning (0) or the end (-1) of a substep."""
            rise, each = (u[-1] - u[0]) * self.substeps / self.dt, [rate]
            for _ in range(1, ORDERS):
                each.append(_in_time(each[-1], rate, rise))
            return jnp.stack([along(of(x, u[at])) for of in each])

        shown = jnp.sum(signed_moments(d, tau) * motion(rows[-1, -1], -1), axis=0)
        past = min(JUMPS, len(rows) - 1) if self.driven else 0
        if not past:
            return shown
        if rows.shape[2] > 1:  # inputs that go on from row to row: their slopes jump at the rows
            at_rows = [motion(rows[-k, 0], 0) - motion(rows[-k - 1, -1], -1) for k in range(1, past + 1)]
            return shown + echo(d, tau, jnp.stack(at_rows), ages(past, self.dt, d.dtype))
        # where an input is late itself, between any two substeps; the rates' slope is that of the latest
        steps = rows[-past - 1 :, :, 0] if self.late_inputs else rows[-past - 1 :, -1:, 0]
        every = jax.vmap(lambda u: rate(x, u))(steps.reshape(-1, steps.shape[-1]))
        count = past * steps.shape[1]
        change = jnp.diff(every, axis=0)[::-1][:count]
        turned = jax.vmap(jax.linearize(lambda x: rate(x, rows[-1, -1, -1]), x)[1])
        orders = [change]
        for _ in range(1, ORDERS):
            orders.append(turned(orders[-1]))
        jumps = jax.vmap(jax.vmap(along))(jnp.stack(orders, axis=1))
        return shown + echo(d, tau, jumps, ages(count, self.dt / steps.shape[1], d.dtype))

    def meant(self, read: Point, rows: Rows, phi: Float[Array, " dp"]) -> Point:
        """Return the states, as prompt sensors show them, of what late ones showed at the end of rows."""
        if not self.states:
            return read
        late = list(self.states)
        moments = signed_moments(*(t[jnp.array(late)] for t in self.times(phi)))

        def rate(x: Point) -> Point:
            return self.whole(x, rows[-1, -1, -1], phi)[0]

        x = read.at[jnp.array(late)].add(-moments[0] * rate(read)[jnp.array(late)])
        columns = []
        for k, row in enumerate(late):
            unit = jnp.zeros_like(x).at[row].set(1.0)
            column, way = jnp.zeros_like(moments[0]).at[k].set(1.0), unit
            for moment in moments:
                way = jax.jvp(rate, (x,), (way,))[1]
                column = column + moment * way[jnp.array(late)]
            columns.append(column)
        slope = jnp.stack(columns, axis=1)

        def step(x: Point, _: None) -> tuple[Point, None]:
            off = (x + self.behind(x, rows, phi)[: len(x)] - read)[jnp.array(late)]
            return x.at[jnp.array(late)].add(-_solved(slope, off)), None

        return jax.lax.scan(step, x, length=STEPS)[0]  # compiled once


def late_of(model: Model, whole: Whole) -> Late | None:
    """Return the late sensors of a model; None: all are prompt. `whole`: of `Late`."""
    if not (model.sensor_delay or model.sensor_lag):
        return None
    names = [q.name for q in (*model.states, *model.outputs)]

    def times(phi: Array) -> tuple[Array, Array]:
        delay, lag = (values_of(model, kind, names, phi) for kind in (model.sensor_delay, model.sensor_lag))
        return jnp.maximum(delay, 0.0), jnp.maximum(lag, 0.0)  # a normal prior has draws beyond its range

    late = model.sensor_delay.keys() | model.sensor_lag.keys()
    states = tuple(i for i, q in enumerate(model.states) if q.name in late)
    late_inputs = bool(model.delay or model.lag)
    return Late(whole, times, states, model.dt, model.substeps, bool(model.inputs), late_inputs)


def behind(model: Model, states: np.ndarray, inputs: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return what late sensors show at the rows of an episode, over what prompt ones would, (T, dx + dy).

    Args:
        model: the simulator.
        states: (T, dx), as prompt sensors show them.
        inputs: (T, du) that act from every row on; they are taken to be held, and before the first as there.
        phi: parameters, (dp,).
    """
    late = late_of(model, to_jax(model.function())) if model.sensor_delay or model.sensor_lag else None
    if late is None:
        return np.zeros((len(states), len(model.states) + len(model.outputs)))
    rows = np.arange(len(inputs))[:, None] - np.arange(JUMPS + 1, 0, -1)[None]
    before = inputs[np.maximum(rows, 0)][:, :, None, None]

    def one(x: Array, rows: Array, now: Array) -> Array:
        return late.behind(x, rows, jnp.asarray(phi), now)

    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(states), jnp.asarray(before), jnp.asarray(inputs)))


def signed_moments(d: Float[Array, "n ..."], tau: Float[Array, "n ..."]) -> Float[Array, "orders n ..."]:
    """Return what the derivatives of a smooth motion count in a late reading: -m_1, m_2, -m_3."""
    found = [-(d + tau)]
    for n in range(2, ORDERS + 1):  # m_n = tau m_(n-1) + d^n/n!
        found.append(-tau * found[-1] + (-d) ** n / math.factorial(n))
    return jnp.stack(found)


def ages(count: int, step: float, dtype: jnp.dtype) -> Float[Array, " K"]:
    """Return how long ago the jumps between so many steps were, s, the latest first."""
    return jnp.arange(1, count + 1, dtype=dtype) * step


def echo(
    d: Float[Array, "ny ..."],
    tau: Float[Array, "ny ..."],
    jumps: Float[Array, "K orders ny ..."],
    ages: Float[Array, " K"],
) -> Float[Array, "ny ..."]:
    """Return what every sensor still shows of the time before its derivatives jumped, so many seconds ago each."""
    return jnp.sum(shares(d, tau, ages) * jumps, axis=(0, 1))


def shares(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], ages: Float[Array, " K"]
) -> Float[Array, "K orders ny ..."]:
    """Return what every sensor still shows of jumps of one, so many seconds ago each: the same for all rows."""
    age, faded = _faded(d, tau, ages)
    behind = signed_moments(jnp.maximum(-age, 0.0), jnp.broadcast_to(tau[None], age.shape))
    return -jnp.swapaxes(behind, 0, 1) * faded[:, None]


def _in_time(function: Callable[..., Array], rate: Callable[..., Array], rise: Array) -> Callable[..., Array]:
    """Return the derivative in time of a function of states and inputs, along the motion."""
    return lambda x, u: jax.jvp(function, (x, u), (rate(x, u), rise))[1]


def _faded(d: Array, tau: Array, ages: Array) -> tuple[Array, Array]:
    """Return the time since each jump that has been shown, and how much of what was before is left."""
    age = ages.reshape(-1, *(1,) * d.ndim) - d[None]
    return age, jnp.exp(-jnp.maximum(age, 0.0) / (tau[None] + 1e-9 * jnp.min(ages)))


def _solved(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a small system near the unit matrix, which needs no pivots: sums that XLA fuses at many points."""
    rows = [jnp.concatenate([a[i], b[i : i + 1]]) for i in range(len(a))]
    for i in range(len(rows)):
        rows[i] = rows[i] / rows[i][i]
        rows = [row if k == i else row - row[i] * rows[i] for k, row in enumerate(rows)]
    return jnp.stack([row[-1] for row in rows])
