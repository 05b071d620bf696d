"""Continuous-discrete extended Kalman filter: innovations of a model on a window of measurements.

    dx = f(x, u; p) dt + q dW,    y_k = h(x_k, u_k; p) + r_k,    r_k ~ N(0, R),  R diagonal

The state is never taken as known, so noise in it does not bias the fit, and a state that no sensor measures needs nothing
special. The process noise q makes the horizon adapt: a wrong model follows the data, the right one is judged on whole
episodes. R is diagonal, so a row of measurements is taken in one scalar after the other (Bierman 1977): no inverse, and
a missing one is left out.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8; Kristensen, Madsen and Jorgensen (2004).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from simpel_cli.casadi_jax import checked, to_jax
from simpel_cli.discovery.augmented import Augmented
from simpel_cli.signals import arriving
from simulators.effects.term import DELAY, LAG, SENSOR_DELAY


class Noise(NamedTuple):
    """Standard deviations of the measurements (ny,) and of the process, per square root of a second (nx,)."""

    r: Float[Array, " ny"]
    q: Float[Array, " nx"]


class Track(NamedTuple):
    """What the filter leaves behind, one row per measured row."""

    innovation: Float[Array, "T ny"]
    variance: Float[Array, "T ny"]
    predicted: Float[Array, "T nx"]
    predicted_cov: Float[Array, "T nx nx"]
    mean: Float[Array, "T nx"]
    cov: Float[Array, "T nx nx"]
    jacobian: Float[Array, "T nx nx"]  # of the transition to the next row


class Filter(NamedTuple):
    """The filter of one augmented model.

    Args:
        track: (p, rows of p that move, noise, y, ok, u, start, spread) -> Track, for one window (see `Windows`).
        flow: (p, x, u of the substeps) -> x one row later.
        measure: (p, x, u) -> what the sensors read.
        arriving: (p, u) -> inputs as they arrive, (T, substeps, nu).
    """

    track: Callable[..., Track]
    flow: Callable[..., Float[Array, " nx"]]
    measure: Callable[..., Float[Array, " ny"]]
    arriving: Callable[..., Float[Array, "T substeps nu"]]


class Active(NamedTuple):
    """Parameters of a model, of which a few can move: only their derivatives are ever formed.

    Args:
        p: (dp,) all of them; derivatives in it are not followed.
        rows: (width,) of p that move; a number beyond the last row is padding.
        moving: (width,) their values; derivatives in it are followed.
    """

    p: Float[Array, " dp"]
    rows: Int[Array, " width"]
    moving: Float[Array, " width"]


def active(p: Float[Array, " dp"], index: Int[Array, " width"]) -> Active:
    """Split parameters into values and moving part."""
    return Active(jax.lax.stop_gradient(p), index, p.at[index].get(mode="fill", fill_value=0.0))


def with_slope(augmented: Augmented, of: int) -> Callable[[Array, Array, Active], tuple[Array, Array]]:
    """Return (x, u, active) -> one result of the model's function and its derivative in x.

    Left to itself, XLA works out every sine anew for every direction of a derivative. Here CasADi differentiates twice,
    the matrix of derivatives is made once per point, and a direction costs a product with its few columns.

    Args:
        augmented: model with candidates.
        of: 0 for the rates, 1 for the sensors.
    """
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    result = augmented.function(x, u, p)[of]
    n, nx, nu = result.numel(), x.numel(), u.numel()
    values = casadi.densify(casadi.vertcat(result, casadi.vec(casadi.jacobian(result, x).T)))
    slopes = casadi.densify(casadi.jacobian(values, casadi.vertcat(x, u, p)))
    names = ["x", "u", "p"]
    model = augmented.model
    ranges = [[(q.low, q.high) for q in group] for group in (model.states, model.inputs, augmented.params)]
    value = checked(casadi.Function("value", [x, u, p], casadi.cse([values]), names, ["v"]), ranges)
    both = to_jax(casadi.Function("both", [x, u, p], casadi.cse([values, slopes]), names, ["v", "dv"]))

    @jax.custom_jvp
    def flat(x: Array, u: Array, p: Array, index: Array, moving: Array) -> Array:
        return value(x, u, p)[0]

    @flat.defjvp
    def _(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        x, u, p, index, _ = primals
        tx, tu, _, _, moved = tangents
        v, dv = both(x, u, p)
        columns = dv[:, nx + nu :].at[:, index].get(mode="fill", fill_value=0.0)
        out = dv[:, :nx] @ tx + columns @ moved
        return v, out + dv[:, nx : nx + nu] @ tu if nu else out

    def point(x: Array, u: Array, given: Active) -> tuple[Array, Array]:
        v = flat(x, u, *given)
        return v[:n], v[n:].reshape(n, nx)

    return point


def filter_of(augmented: Augmented, *, substeps: int, lead: int) -> Filter:
    """Filter of an augmented model, float64.

    Args:
        augmented: model with candidates.
        substeps: Runge-Kutta steps per row.
        lead: rows of past input in front of each window.
    """
    model = augmented.model
    rates, sensors = with_slope(augmented, 0), with_slope(augmented, 1)
    dt, nx, ny, nu = model.dt, len(model.states), len(augmented.measured), len(model.inputs)
    h = dt / substeps
    periodic = {q.name for q in model.states if q.periodic}
    wraps = [name in periodic for name in augmented.measured]
    delays, lags, sensor_delays = (augmented.operators[kind] for kind in (DELAY, LAG, SENSOR_DELAY))

    def per_signal(p: Array, rows: tuple[tuple[int, int], ...], size: int, own: tuple[float, ...] = ()) -> Array:
        values = jnp.asarray(own or (0.0,) * size, p.dtype)
        for signal, row in rows:
            values = values.at[signal].add(p[row])
        return values

    def inputs(p: Array, u: Array) -> Array:
        return arriving(
            u,
            per_signal(p, delays, nu, augmented.own_delay),
            per_signal(p, lags, nu, augmented.own_lag),
            dt=dt,
            substeps=substeps,
            lead=lead,
        )

    def flow(given: Active, x: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return the state one row later, its derivative in the first state, and the rate there with its derivative."""

        # four stages in a scan, inside the scan of the substeps: the expressions are compiled once
        def stage(carry: Any, weights: Array) -> tuple[Any, None]:
            x, phi, u, total, total_phi, slope, slope_phi, _ = carry
            slope, rate_x = rates(x + h * weights[0] * slope, u, given)
            slope_phi = rate_x @ (phi + h * weights[0] * slope_phi)
            after, after_phi = total + h * weights[1] * slope, total_phi + h * weights[1] * slope_phi
            return (x, phi, u, after, after_phi, slope, slope_phi, rate_x), None

        weights = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])
        nothing = jnp.zeros_like(x), jnp.zeros((nx, nx))

        def step(carry: Any, u: Array) -> tuple[Any, None]:
            x, phi, *_ = carry
            end = jax.lax.scan(stage, (x, phi, u, x, phi, *nothing, nothing[1]), weights)[0]
            return (end[3], end[4], end[5], end[7]), None

        return jax.lax.scan(step, (x, jnp.eye(nx), *nothing), u)[0]

    def measure(given: Active, x: Array, u: Array, rate: Array, rate_x: Array) -> tuple[Array, Array]:
        """Return what the sensors read and its derivative in the state; a late one looks back along the rate."""
        y, slope = sensors(x, u, given)
        if not sensor_delays:
            return y, slope
        p = given.p.at[given.rows].set(given.moving, mode="drop")
        late = per_signal(p, sensor_delays, ny)[:, None]
        back = -late * rate + 0.5 * late**2 * (rate_x @ rate)
        return y + jnp.sum(slope * back, axis=1), slope - late * (slope @ rate_x)

    def track(
        p: Array, index: Array, noise: Noise, y: Array, ok: Array, u: Array, start: Array, spread: Array
    ) -> Track:
        given = active(p, index)
        u_sub = inputs(p, u)
        half = jnp.diag(noise.q**2) * (dt / 2)

        def row(carry: tuple[Array, ...], data: tuple[Array, Array, Array]) -> tuple[tuple, Track]:
            x, cov, u_before, rate, rate_x = carry
            y_k, ok_k, u_k = data
            predicted, predicted_cov = x, cov
            # the sensor is read at the row: what arrived up to it is the last substep before
            h_k, slope = measure(given, x, u_before, rate, rate_x)
            errors, variances = [], []
            for j in range(ny):
                c = slope[j]
                gain = cov @ c
                s = c @ gain + noise.r[j] ** 2
                e = y_k[j] - h_k[j]
                e = (jnp.mod(e + jnp.pi, 2 * jnp.pi) - jnp.pi if wraps[j] else e) - c @ (x - predicted)
                weight = ok_k[j] / s
                errors.append(e)
                variances.append(s)
                x = x + gain * (weight * e)
                cov = cov - weight * jnp.outer(gain, gain)
            following, jacobian, rate, rate_x = flow(given, x, u_k)
            after = jacobian @ (cov + half) @ jacobian.T + half
            out = Track(jnp.stack(errors), jnp.stack(variances), predicted, predicted_cov, x, cov, jacobian)
            return (following, after, u_k[-1], rate, rate_x), out

        begin = (start, jnp.diag(spread**2), u_sub[0, 0], jnp.zeros(nx), jnp.zeros((nx, nx)))
        return jax.lax.scan(row, begin, (y, ok, u_sub))[1]

    def plain_flow(p: Array, x: Array, u: Array) -> Array:
        return flow(active(p, jnp.zeros(0, int)), x, u)[0]

    def plain_measure(p: Array, x: Array, u: Array) -> Array:
        return sensors(x, u, active(p, jnp.zeros(0, int)))[0]

    return Filter(track, plain_flow, plain_measure, inputs)
