"""What arrives of the inputs of an augmented model in every substep of a row."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from simpel_cli.dynamics.between_rows import WAY, beyond
from simpel_cli.dynamics.input_delay import delayed_inputs
from simpel_cli.filtering.likelihood.augmented import Augmented
from simulators.effects.term import BACKLASH, BETWEEN_ROWS, DELAY, LAG, ON_INPUT, RATE_LIMIT
from simulators.overshoot import reach


def moving_of(augmented: Augmented) -> tuple[int, ...]:
    """Return the inputs that are not held between rows, or of which it is asked whether they are."""
    return tuple(sorted({*augmented.model.linear, *(signal for signal, _ in augmented.operators[BETWEEN_ROWS])}))


def may_be_late(augmented: Augmented) -> bool:
    """Whether an input may change within a row, as one that is late does."""
    late = (augmented.operators[kind] for kind in ON_INPUT)
    return any(late) or any(augmented.own_delay) or any(augmented.own_lag)


def may_arrive(augmented: Augmented) -> bool:
    """Whether a held input may arrive within a row: late, or slowly."""
    late = (augmented.operators[kind] for kind in (DELAY, LAG))
    return any(late) or any(augmented.own_delay) or any(augmented.own_lag)


def arriving_inputs(augmented: Augmented, substeps: int, lead: int) -> Callable[[Array, Array], Array]:
    """Return the map from parameters (dp, ...) and inputs (lead + T, nu, ...) to inputs of substeps (T, substeps, K, nu, ...).

    K is 3, beginning, middle and end of a substep, where an input is not held between rows or may be late; else 1.

    Args:
        augmented: model with candidates: its own delays and lags of inputs, and those of effects.
        substeps: Runge-Kutta steps per row.
        lead: rows of past input in front of each window.
    """
    model = augmented.model
    nu, linear = len(model.inputs), moving_of(augmented)
    ranges = reach(model) if may_arrive(augmented) else ()
    delays, lags, plays, shares = (augmented.operators[kind] for kind in (DELAY, LAG, BACKLASH, BETWEEN_ROWS))
    slow = augmented.operators[RATE_LIMIT]
    # where it is asked what an input does between rows, the way from held over linear to smooth says so
    said = tuple(WAY[word] for word in model.words_between_rows)

    def late_inputs(p: Array, u: Array) -> Array:
        times = per_signal(p, delays, nu, augmented.own_delay), per_signal(p, lags, nu, augmented.own_lag)
        more = {"half_play": per_signal(p, plays, nu)} if plays else {}
        if slow:
            more["slowness"] = per_signal(p, slow, nu)
        if shares:
            more["way"] = per_signal(p, shares, nu, said)
        if linear:  # nothing is predicted from the last row of a window, but a smooth input reads beyond it before
            u = jnp.concatenate([u, beyond(u)[None] if shares or model.smooth else u[-1:]])

        def one(u: Array, delay: Array, lag: Array, more: dict[str, Array]) -> Array:
            return delayed_inputs(
                u,
                delay,
                lag,
                dt=model.dt,
                substeps=substeps,
                lead=lead,
                linear=linear,
                smooth=model.smooth,
                rising=may_arrive(augmented),
                ranges=ranges,
                **more,
            )

        return _over_points(one, p.ndim - 1)(u, *times, more)

    return late_inputs


def per_signal(p: Array, rows: tuple[tuple[int, int], ...], size: int, own: tuple[float, ...] = ()) -> Array:
    """Return a value for each of so many signals, (size, ...): its own and the parameters that act on it.

    Args:
        p: (dp, ...) parameters.
        rows: signal and parameter of each that acts.
        size: of the signals.
        own: value of each without them; none: 0.
    """
    values = [jnp.full(p.shape[1:], own[i] if own else 0.0, p.dtype) for i in range(size)]
    for signal, row in rows:
        values[signal] = values[signal] + p[row]
    return jnp.stack(values) if values else jnp.zeros((0, *p.shape[1:]), p.dtype)


def _over_points(function: Callable[..., Array], extra: int) -> Callable[..., Array]:
    for _ in range(extra):
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function
