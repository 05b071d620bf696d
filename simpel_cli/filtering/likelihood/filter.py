"""Continuous-discrete extended Kalman filter: innovations of a model on a window of measurements.

    dx = f(x, u; p) dt + q dW,    y_k = h(x_k, u_k; p) + r_k,    r_k ~ N(0, R),  R diagonal

The state is never taken as known, so noise in it does not bias the fit, and a state that no sensor measures needs nothing
special. The process noise q makes the horizon adapt: a wrong model follows the data, the right one is judged on whole
episodes. R is diagonal, so a row of measurements is taken in one scalar after the other (Bierman 1977): no inverse, and
a missing one is left out.

Rows need not be equally far apart, nor values be measured at their row: behind the inputs stand then the step to the next
row, in dt, and how long before its row each value was measured. A measurement of weight w has the noise R/w: one that lies far
off costs itself little and is not thrown away.

All arrays may have trailing axes for many windows and hypotheses at once: the innermost loops then run over contiguous
numbers.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8; Kristensen, Madsen and Jorgensen (2004).
"""

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from simpel_cli.dynamics.input_delay import as_read
from simpel_cli.dynamics.integrate import at_stages
from simpel_cli.filtering.likelihood.arriving import (
    arriving_inputs,
    may_arrive,
    may_be_late,
    moving_of,
    per_signal,
)
from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.clock import at_row, early_of, pace_of
from simpel_cli.filtering.likelihood.covariances import after, counted, diagonal, of_half_a_row, of_row
from simpel_cli.filtering.likelihood.derivatives import RATES, SENSORS, value, with_slope
from simpel_cli.filtering.likelihood.early_values import slope_back, way_back
from simpel_cli.filtering.likelihood.pushes import Timing, pushes_of
from simpel_cli.filtering.likelihood.sensor_delay import (
    JUMPS,
    Motion,
    back,
    moving,
    no_jumps,
    pushed,
    pushed_within,
    shares_of,
    still_shown,
)
from simpel_cli.filtering.likelihood.small_matrices import along, apart, applied, product, sure_of
from simpel_cli.filtering.likelihood.tangents import slopes_of
from simpel_cli.filtering.likelihood.track import Filter, Held, Noise, Track
from simulators.effects.term import ON_INPUT, SENSOR_DELAY, SENSOR_LAG
from simulators.overshoot import reach

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
        augmented.measured, tuple(sorted(augmented.operators.items())), augmented.own_delay, augmented.own_lag,
        augmented.own_late, model.linear, model.smooth, augmented.remainders, substeps, lead,
        reach(model) if may_arrive(augmented) else (),
    )  # fmt: skip
    if key not in _KEPT:
        name = hashlib.sha256(repr(key).encode()).hexdigest()
        remainders = augmented.driven if augmented.remainders else ()
        _KEPT[key] = _filter_of(augmented, substeps, lead)._replace(name=name, remainders=remainders)
        while len(_KEPT) > MOST_KEPT:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    return _KEPT[key]


def _filter_of(augmented: Augmented, substeps: int, lead: int) -> Filter:
    model = augmented.model
    dt, nx, ny, nu = model.dt, len(model.states), len(augmented.measured), len(model.inputs)
    rates, sensors = (_of_inputs(with_slope(augmented, of), nu) for of in (RATES, SENSORS))
    plain_rates = _of_inputs(value(augmented, RATES), nu)
    periodic = {q.name for q in model.states if q.periodic}
    wraps = [name in periodic for name in augmented.measured]
    linear = moving_of(augmented)
    sensor_delays, sensor_lags = (augmented.operators[kind] for kind in (SENSOR_DELAY, SENSOR_LAG))

    late_inputs = arriving_inputs(augmented, substeps, lead)

    def inputs(p: Array, u: Array) -> Array:
        """Return the inputs of every substep, and behind them what stands behind the inputs of a row."""
        arriving = late_inputs(p, u[:, :nu])
        if u.shape[1] == nu:
            return arriving
        clock = u[lead:, None, None, nu:]
        return jnp.concatenate([arriving, jnp.broadcast_to(clock, (*arriving.shape[:3], *clock.shape[3:]))], axis=3)

    # four stages in a scan, inside the scan of the substeps: the expressions are compiled once
    stages = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])

    def length(u: Array, axes: int = 1) -> Array | float:
        """Return the length of a substep, s, for a value with so many axes of its own."""
        pace = pace_of(u, nu)
        return dt / substeps if pace is None else (dt / substeps * pace).reshape((1,) * axes + pace.shape)

    def in_stages(stage: Callable[..., Any], carry: Any, u: Array) -> Any:
        """Scan the stages of a substep; what is held is no datum of the scan."""
        if len(u) == 1:
            return jax.lax.scan(lambda carry, weights: stage(carry, (weights, u[0])), carry, stages)
        return jax.lax.scan(stage, carry, (stages, at_stages(u)))

    def flow(p: Array, x: Array, u: Array) -> Array:
        """Return the state one row later."""

        def step(x: Array, u: Array) -> tuple[Array, None]:
            def stage(carry: tuple[Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
                (total, slope), (weights, u) = carry, now
                h = length(u)
                slope = plain_rates(x + h * weights[0] * slope, u, p)
                return (total + h * weights[1] * slope, slope), None

            return in_stages(stage, (x, jnp.zeros_like(x)), u)[0][0], None

        return jax.lax.scan(step, x, u)[0]

    def flow_with_slope(p: Array, x: Array, u: Array, sure: Array) -> tuple[tuple[Array, Array, Array, Array], Any]:
        """Return the state one row later, its derivative in the first state, and the rate there with its derivative.

        Behind them: the states at the beginning, in the middle and at the end of every substep, (substeps, 3, nx, ...), and the
        slopes of the rates there.
        """

        def stage(carry: Any, now: tuple[Array, Array]) -> tuple[Any, tuple[Array, Array]]:
            (x, phi, total, total_phi, slope, slope_phi, _), (weights, u) = carry, now
            h, h_phi = length(u), length(u, 2)
            there = x + h * weights[0] * slope
            slope, rate_x = apart(sure, rates, there, u, p)
            slope_phi = apart(sure, product, rate_x, phi + h_phi * weights[0] * slope_phi)
            end, end_phi = total + h * weights[1] * slope, total_phi + h_phi * weights[1] * slope_phi
            return (x, phi, end, end_phi, slope, slope_phi, rate_x), (there, rate_x)

        nothing = jnp.zeros_like(x), jnp.zeros((nx, *x.shape), x.dtype)
        unit = nothing[1] + along(jnp.eye(nx), x.ndim - 1)

        def step(carry: Any, u: Array) -> tuple[Any, tuple[Array, Array]]:
            x, phi, *_ = carry
            end, passed = in_stages(stage, (x, phi, x, phi, *nothing, nothing[1]), u)
            return (end[2], end[3], end[4], end[6]), jax.tree.map(lambda a: a[jnp.array([0, 2, 3])], passed)

        return jax.lax.scan(step, (x, unit, *nothing), u)

    own_delays, own_lags = augmented.own_late
    late_ones = bool(sensor_delays or sensor_lags or any(own_delays) or any(own_lags))
    # an input that is late itself makes a motion jump within a row
    parts = substeps if may_be_late(augmented) else 1
    overshoots = may_arrive(augmented)  # at the ends of its line in a step

    def late_by(p: Array) -> tuple[Array, Array]:
        """Return delay d and lag tau of every sensor, (ny, ...)."""
        return per_signal(p, sensor_delays, ny, own_delays), per_signal(p, sensor_lags, ny, own_lags)

    def late_of(p: Array) -> tuple[Array, Array, Array] | None:
        """Return these, and what is still shown of jumps of one; None: no sensor is late."""
        return (*(late := late_by(p)), shares_of(*late, JUMPS * parts, dt, parts)) if late_ones else None

    def moving_in(p: Array, x: Array, u: Array, rate: Array, rate_x: Array) -> Motion:
        """Return the motion at a point of a row; u: of its substep. What is held jumps, others rise or fall in it."""
        if not (linear and late_ones):
            return moving(rate, rate_x)
        first, last = (plain_rates(x, end, p) for end in (u[0], u[-1]))
        return moving(rate, rate_x, (last - first) / length(u[0]))

    def shown(u: Array, axis: int) -> Array:
        """Return inputs of substeps as readings go by them (`as_read`); axis: of K."""
        return as_read(u, linear, axis)

    def arrived(within: Array, last: Array, u: Array, p: Array) -> tuple[Array, Array]:
        """Return how the rates jump between the substeps of a row, (substeps - 1, nx, ...), and what they are at its end.

        Args:
            within: (substeps - 1, nx, ...) states between them.
            last: (nx, ...) at the end.
            u: as readings go by it: in a step of the integrator the line of an input that arrives overshoots.
            p: parameters.
        """
        points = jnp.concatenate([within, within, last[None]]), jnp.concatenate([u[1:, 0], u[:-1, -1], u[-1:, -1]])
        rate = jax.vmap(lambda x, u: plain_rates(x, u, p))(*points)
        return rate[: substeps - 1] - rate[substeps - 1 : -1], rate[-1]

    def seen(
        p: Array,
        x: Array,
        inputs: tuple[Array, Array],
        motion: Motion,
        rate_x: Array,
        jumps: Array,
        begin: tuple[Array, ...],
        late: tuple[Array, Array, Array] | None,
    ) -> tuple[Array, Array, Array]:
        """Return what the sensors read, its derivative in the state, and the latter if no sensor were late.

        `inputs`: until the row, and from it on.
        """
        y, prompt = at_row(lambda u: sensors(x, u, p), *inputs, nu)
        read, slope = y, prompt
        if (early := early_of(inputs[1], nu)) is not None:
            read = read + jnp.sum(prompt * way_back(early, x, motion.rate, begin), axis=1)
            slope = slope_back(early, prompt, rate_x)
        if late is not None:
            d, tau, shares = late
            read = read + jnp.sum(prompt * back(d, tau, motion), axis=1) + still_shown(shares, jumps)
            slope = slope - (d + tau)[:, None] * product(prompt, rate_x)
        return read, slope, prompt

    def wrapped(error: Array) -> Array:
        """Take a difference of angles the short way round; error: (ny, ...)."""
        if not any(wraps):
            return error
        return jnp.where(along(jnp.array(wraps), error.ndim - 1), jnp.mod(error + jnp.pi, 2 * jnp.pi) - jnp.pi, error)

    def taken(
        state: tuple[Array, Array, Array], reach: Array, off: Array, c: Array, noise: Array, ok: Array
    ) -> tuple[Array, ...]:
        """Take one measurement in: state and covariance after it, innovation, variance and gain.

        `state`: as predicted for the row, now, and its covariance; `reach`: covariance with what is read; `c`: slope of that.
        """
        predicted, x, cov = state
        s = product(c[None], reach[:, None])[0, 0] + noise
        e = off - product(c[None], (x - predicted)[:, None])[0, 0]
        gain = (ok / s)[None] * reach
        return x + gain * e[None], cov - gain[:, None] * reach[None], e, s, gain

    def track(p: Array, noise: Noise, y: Array, ok: Array, u: Array, start: Array, spread: Array) -> tuple[Track, Held]:
        u_sub, half, sure = inputs(p, u), of_half_a_row(noise.q, dt), sure_of(noise.r)
        late = late_of(p)

        def row(carry: tuple[Any, ...], data: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Track, Held]]:
            x, cov, u_before, motion, rate_x, jumps, begin = carry
            y_k, (ok_k, larger), u_k = data
            acts = shown(u_k, 1)
            predicted, predicted_cov, pace = x, cov, pace_of(acts[0, 0], nu)
            h_k, slope, prompt = seen(p, x, (u_before, acts[0, 0]), motion, rate_x, jumps, begin, late)
            before = (motion, jumps) if late_ones else (None, None)
            if late_ones:
                jumps = pushed(jumps, prompt, motion, moving_in(p, x, acts[0], *rates(x, acts[0, 0], p)))
            off = wrapped(y_k - h_k)
            errors, variances, gains = [], [], []
            for j in range(ny):
                reach = apart(sure, applied, cov, slope[j])
                given = (predicted, x, cov), reach, off[j], slope[j], noise.r[j] ** 2 * larger[j], ok_k[j]
                x, cov, e, s, gain = apart(sure, taken, *given)
                errors.append(e)
                variances.append(s)
                gains.append(gain)
            (following, jacobian, rate_after, rate_x_after), passed = flow_with_slope(p, x, u_k, sure)
            stages, stage_x = passed
            innovation, variance = jnp.stack(errors), jnp.stack(variances)
            out = Track(innovation, variance, predicted, predicted_cov, x, cov, jacobian, slope)
            held = Held(jnp.stack(gains), prompt, rate_x, pace, u_k, stages, stage_x, *before)
            begin = () if pace is None else (x, rates(x, acts[0, 0], p)[0], dt * pace)
            if (late_ones and parts > 1) or (overshoots and (late_ones or pace is not None)):
                change, rate_after = arrived(stages[1:, 0], following, acts, p)
            motion = moving_in(p, following, acts[-1], rate_after, rate_x_after)
            if late_ones:
                begun = moving_in(p, x, acts[0], *rates(x, acts[0, 0], p))
                motion = motion.since(begun, dt if pace is None else dt * pace[None])
                if parts > 1:
                    jumps = pushed_within(jumps, prompt, change, rate_x_after)
            carry = (
                following,
                after(cov, jacobian, of_row(half, pace), sure),
                acts[-1, -1],
                motion,
                rate_x_after,
                jumps,
                begin,
            )
            return carry, (out, held)

        begun_with = shown(u_sub[0], 1)[0]
        first = begun_with[0]
        rate, rate_x = rates(start, first, p)
        motion = moving_in(p, start, begun_with, rate, rate_x)  # as if it had been going on so
        begin = (
            start,
            diagonal(spread),
            first,
            motion,
            rate_x,
            no_jumps(ny, start, JUMPS * parts),
            at_rest(first, start, rate),
        )
        return jax.lax.scan(row, begin, (y, counted(ok), u_sub))[1]

    def at_rest(u: Array, x: Array, rate: Array) -> tuple[Array, ...]:
        """Return what came before the first row: the same rate."""
        return () if pace_of(u, nu) is None else (x - dt * rate, rate, jnp.full(x.shape[1:], dt, x.dtype))

    def plain_measure(p: Array, x: Array, u: Array) -> Array:
        return sensors(x, u, p)[0]

    def read(p: Array, x_before: Array, u_before: Array, x: Array, u: Array, jumps: Array) -> tuple[Array, Array]:
        u_before, u = shown(u_before, 1), shown(u, 1)
        end = u_before[-1, -1]
        now, slope = at_row(lambda u: sensors(x, u, p), end, u[0, 0], nu)
        pace, early = pace_of(end, nu), early_of(u[0, 0], nu)
        if pace is not None and early is not None:
            begin = x_before, rates(x_before, u_before[0, 0], p)[0], dt * pace
            now = now + jnp.sum(slope * way_back(early, x, rates(x, end, p)[0], begin), axis=1)
        if (late := late_of(p)) is not None:
            (d, tau, shares), motion = late, moving_in(p, x, u_before[-1], *rates(x, end, p))
            begun = moving_in(p, x_before, u_before[0], *rates(x_before, u_before[0, 0], p))
            motion = motion.since(begun, dt if pace is None else dt * pace[None])
            now = now + jnp.sum(slope * back(d, tau, motion), axis=1) + still_shown(shares, jumps)
            going = moving_in(p, x, u[0], *rates(x, u[0, 0], p))
            jumps = pushed(jumps, slope, motion, going)
            if parts > 1:
                middle = x + substeps / 2 * length(u[0, 0]) * going.rate
                change, _ = arrived(jnp.broadcast_to(middle, (substeps - 1, *middle.shape)), middle, u, p)
                jumps = pushed_within(jumps, slope, change, rates(x, u[0, 0], p)[1])
        return now, jumps

    of_inputs = sorted({row for kind in ON_INPUT for _, row in augmented.operators[kind]})
    timing = Timing(dt, substeps, inputs, of_inputs, late_by if late_ones else None, linear, parts, overshoots)
    return Filter(
        "", track, pushes_of(augmented, timing), slopes_of(augmented, timing), flow, plain_measure, read, inputs,
        JUMPS * parts,
    )  # fmt: skip


def _of_inputs(function: Any, nu: int) -> Any:
    """Take what stands behind the inputs away from a function of (x, u, ...)."""
    return lambda x, u, *given: function(x, u[:nu], *given)
