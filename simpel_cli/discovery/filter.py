"""Continuous-discrete extended Kalman filter: innovations of a model on a window of measurements.

    dx = f(x, u; p) dt + q dW,    y_k = h(x_k, u_k; p) + r_k,    r_k ~ N(0, R),  R diagonal

The state is never taken as known, so noise in it does not bias the fit, and a state that no sensor measures needs nothing
special. The process noise q makes the horizon adapt: a wrong model follows the data, the right one is judged on whole
episodes. R is diagonal, so a row of measurements is taken in one scalar after the other (Bierman 1977): no inverse, and
a missing one is left out.

All arrays may have trailing axes for many windows and hypotheses at once: the innermost loops then run over contiguous
numbers.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8; Kristensen, Madsen and Jorgensen (2004).
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from simpel_cli.discovery.augmented import Augmented
from simpel_cli.discovery.slopes import with_slope
from simpel_cli.signals import arriving
from simulators.effects.term import BACKLASH, DELAY, LAG, SENSOR_DELAY, SENSOR_LAG


class Noise(NamedTuple):
    """Standard deviations of the measurements (ny, ...) and of the process, per square root of a second (nx, ...)."""

    r: Float[Array, "ny ..."]
    q: Float[Array, "nx ..."]


class Track(NamedTuple):
    """What the filter leaves behind, one row per measured row."""

    innovation: Float[Array, "T ny ..."]
    variance: Float[Array, "T ny ..."]
    predicted: Float[Array, "T nx ..."]
    predicted_cov: Float[Array, "T nx nx ..."]
    mean: Float[Array, "T nx ..."]
    cov: Float[Array, "T nx nx ..."]
    jacobian: Float[Array, "T nx nx ..."]  # of the transition to the next row
    slope: Float[Array, "T ny nx ..."]  # of what the sensors read, in the predicted state


class Filter(NamedTuple):
    """The filter of one augmented model; every array may have further axes behind those named here.

    Args:
        track: (moving, noise, y, ok, u, start, spread) -> Track, for one window (see `Windows`).
        flow: (p, x, u of the substeps) -> x one row later.
        measure: (p, x, u) -> what the sensors read.
        arriving: (p, u) -> inputs as they arrive, (T, substeps, nu).
    """

    track: Callable[..., Track]
    flow: Callable[..., Float[Array, " nx"]]
    measure: Callable[..., Float[Array, " ny"]]
    arriving: Callable[..., Float[Array, "T substeps nu"]]


class Moving(NamedTuple):
    """Parameters of a model, of which at most one moves in the direction of a derivative.

    Args:
        p: (dp, ...) all of them. The model's own derivatives in it are not followed, those of delays and lags are.
        row: (...) of p that moves; a number beyond the last row: none.
        value: (...) its value: derivatives in it are followed.
    """

    p: Float[Array, "dp ..."]
    row: Int[Array, "..."]
    value: Float[Array, "..."]


def still(p: Float[Array, "dp ..."]) -> Moving:
    """Parameters of which none moves."""
    points = p.shape[1:]
    return Moving(p, jnp.full(points, p.shape[0]), jnp.zeros(points, p.dtype))


_KEPT: OrderedDict[tuple, Filter] = OrderedDict()
MOST_KEPT = (
    16  # filters; searches of one process that differ in their measurements only share what was traced and compiled
)


def filter_of(augmented: Augmented, *, substeps: int, lead: int) -> Filter:
    """Filter of an augmented model, float64; the same object for models that are the same.

    Args:
        augmented: model with candidates.
        substeps: Runge-Kutta steps per row.
        lead: rows of past input in front of each window.
    """
    model = augmented.model
    key = (
        augmented.function.serialize(), model.dt, tuple(q.periodic for q in model.states), tuple(q.name for q in model.states),
        augmented.measured, tuple(sorted(augmented.operators.items())), augmented.own_delay, augmented.own_lag, substeps,
        lead,
    )  # fmt: skip
    if key not in _KEPT:
        _KEPT[key] = _filter_of(augmented, substeps, lead)
        while len(_KEPT) > MOST_KEPT:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    return _KEPT[key]


def _filter_of(augmented: Augmented, substeps: int, lead: int) -> Filter:
    model = augmented.model
    rates, sensors = with_slope(augmented, 0), with_slope(augmented, 1)
    dt, nx, ny, nu = model.dt, len(model.states), len(augmented.measured), len(model.inputs)
    h = dt / substeps
    periodic = {q.name for q in model.states if q.periodic}
    wraps = [name in periodic for name in augmented.measured]
    delays, lags, plays = (augmented.operators[kind] for kind in (DELAY, LAG, BACKLASH))
    sensor_delays, sensor_lags = (augmented.operators[kind] for kind in (SENSOR_DELAY, SENSOR_LAG))

    def per_signal(p: Array, rows: tuple[tuple[int, int], ...], size: int, own: tuple[float, ...] = ()) -> Array:
        values = [jnp.full(p.shape[1:], own[i] if own else 0.0, p.dtype) for i in range(size)]
        for signal, row in rows:
            values[signal] = values[signal] + p[row]
        return jnp.stack(values) if values else jnp.zeros((0, *p.shape[1:]), p.dtype)

    def inputs(p: Array, u: Array) -> Array:
        times = per_signal(p, delays, nu, augmented.own_delay), per_signal(p, lags, nu, augmented.own_lag)
        widths = (per_signal(p, plays, nu),) if plays else ()

        def one(u: Array, delay: Array, lag: Array, *play: Array) -> Array:
            return arriving(u, delay, lag, dt=dt, substeps=substeps, lead=lead, half_play=play[0] if play else None)

        return _over_points(one, p.ndim - 1)(u, *times, *widths)

    def flow(given: Moving, x: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return the state one row later, its derivative in the first state, and the rate there with its derivative."""

        # four stages in a scan, inside the scan of the substeps: the expressions are compiled once
        def stage(carry: Any, weights: Array) -> tuple[Any, None]:
            x, phi, u, total, total_phi, slope, slope_phi, _ = carry
            slope, rate_x = apart(rates(x + h * weights[0] * slope, u, given))
            slope_phi = apart(product(rate_x, apart(phi + h * weights[0] * slope_phi)))
            after, after_phi = total + h * weights[1] * slope, total_phi + h * weights[1] * slope_phi
            return (x, phi, u, after, after_phi, slope, slope_phi, rate_x), None

        weights = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])
        nothing = jnp.zeros_like(x), jnp.zeros((nx, *x.shape), x.dtype)
        unit = nothing[1] + along(jnp.eye(nx), x.ndim - 1)

        def step(carry: Any, u: Array) -> tuple[Any, None]:
            x, phi, *_ = carry
            end = jax.lax.scan(stage, (x, phi, u, x, phi, *nothing, nothing[1]), weights)[0]
            return (end[3], end[4], end[5], end[7]), None

        return jax.lax.scan(step, (x, unit, *nothing), u)[0]

    def measure(given: Moving, x: Array, u: Array, rate: Array, rate_x: Array) -> tuple[Array, Array]:
        """Return what the sensors read and its derivative in the state; a late one looks back along the rate.

        A delay d and a lag tau act together as exp(-d s)/(1 + tau s), to second order

            y - (d + tau) y' + (d^2/2 + d tau + tau^2) y''

        which holds while d and tau are short against the motion (the next term is about tau^3 times the third
        derivative) and against the time since the input last changed: y' and y'' are those of the substep that just ended.
        """
        y, slope = sensors(x, u, given)
        if not (sensor_delays or sensor_lags):
            return y, slope
        d, tau = (per_signal(given.p, rows, ny)[:, None] for rows in (sensor_delays, sensor_lags))
        late, twice = d + tau, 0.5 * d**2 + d * tau + tau**2
        back = -late * rate[None] + twice * product(rate_x, rate[:, None])[None, :, 0]
        return y + jnp.sum(slope * back, axis=1), slope - late * product(slope, rate_x)

    def track(given: Moving, noise: Noise, y: Array, ok: Array, u: Array, start: Array, spread: Array) -> Track:
        u_sub = inputs(given.p, u)
        extra = start.ndim - 1
        half = along(jnp.eye(nx), extra) * (noise.q**2 * (dt / 2))[None]

        def row(carry: tuple[Array, ...], data: tuple[Array, Array, Array]) -> tuple[tuple, Track]:
            x, cov, u_before, rate, rate_x = carry
            y_k, ok_k, u_k = data
            predicted, predicted_cov = x, cov
            # the sensor is read at the row: what arrived up to it is the last substep before
            h_k, slope = measure(given, x, u_before, rate, rate_x)
            errors, variances = [], []
            for j in range(ny):
                c = slope[j]
                gain = apart(product(cov, c[:, None])[:, 0])
                s = product(c[None], gain[:, None])[0, 0] + noise.r[j] ** 2
                e = y_k[j] - h_k[j]
                e = jnp.mod(e + jnp.pi, 2 * jnp.pi) - jnp.pi if wraps[j] else e
                e = e - product(c[None], (x - predicted)[:, None])[0, 0]
                weight, pull = apart((ok_k[j] / s, ok_k[j] * e / s))
                errors.append(e)
                variances.append(s)
                x = x + gain * pull[None]
                cov = cov - (weight[None] * gain)[:, None] * gain[None]
                x, cov = apart((x, cov))
            following, jacobian, rate, rate_x = flow(given, x, u_k)
            after = product(apart(product(jacobian, cov + half)), jnp.swapaxes(jacobian, 0, 1)) + half
            out = Track(jnp.stack(errors), jnp.stack(variances), predicted, predicted_cov, x, cov, jacobian, slope)
            return (following, after, u_k[-1], rate, rate_x), out

        nothing = jnp.zeros_like(start), jnp.zeros((nx, *start.shape), start.dtype)
        begin = (start, along(jnp.eye(nx), extra) * (spread**2)[None], u_sub[0, 0], *nothing)
        return jax.lax.scan(row, begin, (y, ok, u_sub))[1]

    def plain_flow(p: Array, x: Array, u: Array) -> Array:
        return flow(still(p), x, u)[0]

    def plain_measure(p: Array, x: Array, u: Array) -> Array:
        return sensors(x, u, still(p))[0]

    return Filter(track, plain_flow, plain_measure, inputs)


def product(a: Float[Array, "n k ..."], b: Float[Array, "k m ..."]) -> Float[Array, "n m ..."]:
    """Product of small matrices at every point: sums that XLA fuses, where it would call a matrix routine per point."""
    return sum((a[:, j, None] * b[None, j] for j in range(1, a.shape[1])), a[:, 0, None] * b[None, 0])


def apart(values: Any) -> Any:
    """Keep XLA from working values out again in every place that uses them."""
    return jax.lax.optimization_barrier(values)


def along(a: Array, extra: int) -> Array:
    """Append axes of length one, so that an array is the same at all points."""
    return a.reshape(*a.shape, *(1,) * extra)


def _over_points(function: Callable[..., Array], extra: int) -> Callable[..., Array]:
    for _ in range(extra):
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function
