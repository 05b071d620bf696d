"""Inputs as they arrive: through a play, delayed and lagged, as means over the integrator's substeps.

A held input is a staircase; the mean over a substep that lies d in the past is a sum over samples, each weighted with the
share of the substep that it fills: continuous in d, below one sample too.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def delayed_inputs(
    u: Float[Array, "R nu"],
    delay: Float[Array, " nu"],
    lag: Float[Array, " nu"],
    *,
    dt: float,
    substeps: int,
    lead: int,
    half_play: Float[Array, " nu"] | None = None,
) -> Float[Array, "T substeps nu"]:
    """Return the input of every substep of the rows behind the lead.

    Args:
        u: inputs, held from a row to the next; the first `lead` rows are the past.
        delay: s, per input.
        lag: time constant of a first-order lag behind the delay, s, per input; 0 = none.
        dt: distance of the rows, s.
        substeps: per row.
        lead: rows of the past; no delay is longer.
        half_play: half width of a play in front of the delay, in units of u, per input (see `play`); None: of no input.
    """
    if half_play is not None:
        u = play(u, half_play)
    rows, h = u.shape[0], dt / substeps
    order = jnp.arange(1, rows * substeps + 1, dtype=u.dtype)
    # the row of every weight, behind the end of every substep; whole numbers and fractions, no floor: two compiled loops may
    # round a quotient to two sides of a row, and read one sample with the weight of another
    back = jnp.arange(lead, -1, -1, dtype=u.dtype)[None] + (jnp.arange(substeps + 1, dtype=u.dtype) / substeps)[:, None]
    held = jnp.concatenate([jnp.repeat(u[:1], lead, axis=0), u])  # before the record the first input was held
    near = held[jnp.arange(rows)[:, None] + jnp.arange(lead + 1)[None]]

    def one(near: Array, d: Array, tau: Array) -> Array:
        passed = back - d / dt
        weight = jnp.diff(_ramp(passed), axis=0) * substeps
        weight = weight.at[:, 0].add(1 - jnp.sum(weight, axis=1))  # later than all that is known: the oldest
        mean = jnp.dot(near, weight.T, precision=jax.lax.Precision.HIGHEST).reshape(-1)
        # exact answer of the lag to a staircase; its mean over a substep
        ratio = h / (tau + 1e-15 * h)
        keep = jnp.exp(-ratio)

        def join(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
            return a[0] * b[0], a[1] * b[0] + b[1]

        _, ends = jax.lax.associative_scan(join, (jnp.full_like(mean, keep), (1 - keep)[None] * mean))
        ends = ends + jnp.exp(-ratio[None] * order) * mean[:1]  # settled before the record
        before = jnp.concatenate([mean[:1], ends[:-1]])
        return mean + (before - mean) * ((1 - keep) / ratio)[None]

    every = jax.vmap(one, in_axes=(2, 0, 0), out_axes=1)(near, delay, lag)
    return every.reshape(rows, substeps, -1)[lead:]


def _ramp(passed: Array) -> Array:
    """Return how much of a sample has passed, from 0 to 1; at both ends the slope is that of a delay that begins to grow."""
    return jnp.where(passed <= 0, 0.0, jnp.where(passed > 1, 1.0, passed))


def play(u: Float[Array, "R nu"], half: Float[Array, " nu"]) -> Float[Array, "R nu"]:
    """Return what passes a backlash: the output stays until the input has crossed the play, then follows at its edge.

        v_k = min(u_k + c, max(u_k - c, v_{k-1}))

    Before the record the input is taken to lie in the middle of the play. The slope in c where c = 0 is that of a play that
    begins to open: an edge that is only touched counts as reached, which min and max would leave half undecided.

    Args:
        u: inputs, row by row.
        half: c, half width of the play, in units of u, per input; 0 = none.

    Reference: Visintin (1994), Differential models of hysteresis, ch. III.2 (the play operator).
    """

    def row(before: Array, now: Array) -> tuple[Array, Array]:
        low, high = now - half, now + half
        after = jnp.where(before < low, low, jnp.where(before > high, high, before))
        return after, after

    return jax.lax.scan(row, u[0], u)[1]
