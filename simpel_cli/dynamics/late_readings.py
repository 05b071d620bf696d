"""States and outputs as late sensors show them, and states from what such sensors showed, for one point.

A delay d and a lag tau act together as exp(-d s)/(1 + tau s). Along a smooth motion that is, to second order,

    y = c - (d + tau) c' + (d^2/2 + d tau + tau^2) c'',    c: what a prompt sensor shows

which holds while d and tau are short against the motion (the next term is about tau^3 times the third derivative). Inputs
are held from a row to the next, so c' jumps at the rows. A jump J at age a adds what the motion since then does not show,

    J tau exp((d - a)/tau)  where d <= a,    J (d + tau - a)  where the delay reaches behind it,

and one of c'' likewise, -J tau^2 exp((d - a)/tau) or -J ((d - a)^2/2 + (d - a) tau + tau^2). What y says of the state is
solved for by Newton's method with one slope: exact in one step for a linear system.
"""

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
    """

    whole: Whole
    times: Callable[[Array], tuple[Array, Array]]
    states: tuple[int, ...]
    dt: float
    substeps: int
    driven: bool

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

        def motion(u: Float[Array, "K du"], at: int) -> tuple[Array, Array]:
            """Return c' and c'' at the beginning (0) or the end (-1) of a substep."""
            rise = (u[-1] - u[0]) * self.substeps / self.dt
            first, second = jax.jvp(
                lambda x, u: self.whole(x, u, phi)[0], (x, u[at]), (self.whole(x, u[at], phi)[0], rise)
            )
            return along(first), along(second)

        first, second = motion(rows[-1, -1], -1)
        shown = -(d + tau) * first + (0.5 * d**2 + d * tau + tau**2) * second
        past = min(JUMPS, len(rows) - 1) if self.driven else 0
        if not past:
            return shown
        both = [(motion(rows[-k, 0], 0), motion(rows[-k - 1, -1], -1)) for k in range(1, past + 1)]
        once, twice = (jnp.stack([to[i] - was[i] for to, was in both]) for i in (0, 1))
        return shown + echo(d, tau, once, self.dt) - echo_of_curvature(d, tau, twice, self.dt)

    def meant(self, read: Point, rows: Rows, phi: Float[Array, " dp"]) -> Point:
        """Return the states, as prompt sensors show them, of what late ones showed at the end of rows."""
        if not self.states:
            return read
        late = list(self.states)
        d, tau = (t[jnp.array(late)] for t in self.times(phi))
        second = 0.5 * d**2 + d * tau + tau**2

        def rate(x: Point) -> Point:
            return self.whole(x, rows[-1, -1, -1], phi)[0]

        x = read.at[jnp.array(late)].add((d + tau) * rate(read)[jnp.array(late)])
        columns = []
        for k, row in enumerate(late):
            unit = jnp.zeros_like(x).at[row].set(1.0)
            once = jax.jvp(rate, (x,), (unit,))[1]
            twice = jax.jvp(rate, (x,), (once,))[1]
            own = jnp.zeros_like(d).at[k].set(1.0)
            columns.append(own - (d + tau) * once[jnp.array(late)] + second * twice[jnp.array(late)])
        slope = jnp.stack(columns, axis=1)
        for _ in range(STEPS):
            off = (x + self.behind(x, rows, phi)[: len(x)] - read)[jnp.array(late)]
            x = x.at[jnp.array(late)].add(-_solved(slope, off))
        return x


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
    return Late(whole, times, states, model.dt, model.substeps, bool(model.inputs))


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


def echo(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], jumps: Float[Array, "K ny ..."], dt: float
) -> Float[Array, "ny ..."]:
    """Return what every sensor still shows of the time before its rates jumped; jumps: the latest first."""
    age, faded = _faded(d, tau, len(jumps), dt)
    return jnp.sum((tau[None] * faded - jnp.minimum(age, 0.0)) * jumps, axis=0)


def echo_of_curvature(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], jumps: Float[Array, "K ny ..."], dt: float
) -> Float[Array, "ny ..."]:
    """Return the same of jumps of the second derivative."""
    age, faded = _faded(d, tau, len(jumps), dt)
    ahead = jnp.maximum(-age, 0.0)
    return jnp.sum((0.5 * ahead**2 + ahead * tau[None] + tau[None] ** 2 * faded) * jumps, axis=0)


def _faded(d: Array, tau: Array, count: int, dt: float) -> tuple[Array, Array]:
    """Return the time since so many rows that has been shown, and how much of what was before is left; the latest first."""
    ages = jnp.arange(1, count + 1, dtype=d.dtype) * dt
    age = ages.reshape(-1, *(1,) * d.ndim) - d[None]
    return age, jnp.exp(-jnp.maximum(age, 0.0) / (tau[None] + 1e-9 * dt))


def _solved(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a small system near the unit matrix, which needs no pivots: sums that XLA fuses at many points."""
    rows = [jnp.concatenate([a[i], b[i : i + 1]]) for i in range(len(a))]
    for i in range(len(rows)):
        rows[i] = rows[i] / rows[i][i]
        rows = [row if k == i else row - row[i] * rows[i] for k, row in enumerate(rows)]
    return jnp.stack([row[-1] for row in rows])
