"""Inputs as they arrive: through a play, at a limited rate, held or linear between rows, delayed and lagged, over substeps.

A held input is a staircase; the mean over a substep that lies d in the past is a sum over samples, each weighted with the
share of the substep that it fills: continuous in d, below one sample too. A linear input is a sum of hat functions; over a
substep it is taken for the straight line that has its mean and its first moment.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STAGES = (-0.5, 0.0, 0.5)  # of a Runge-Kutta step: beginning, middle and end, from the middle of a substep


def delayed_inputs(
    u: Float[Array, "R nu"],
    delay: Float[Array, " nu"],
    lag: Float[Array, " nu"],
    *,
    dt: float,
    substeps: int,
    lead: int,
    half_play: Float[Array, " nu"] | None = None,
    slowness: Float[Array, " nu"] | None = None,
    linear: Sequence[int] = (),
    share: Float[Array, " nu"] | None = None,
) -> Float[Array, "T substeps K nu"]:
    """Return the input of every substep of the rows behind the lead.

    Args:
        u: inputs; the first `lead` rows are the past. Where one is linear, there is a row more: the one after the last.
        delay: s, per input.
        lag: time constant of a first-order lag behind the delay, s, per input; 0 = none.
        dt: distance of the rows, s.
        substeps: per row.
        lead: rows of the past; no delay is longer.
        half_play: half width of a play in front of the delay, in units of u, per input (see `play`); None: of no input.
        slowness: s per unit of u that its actuator moves, per input, behind the play (see `slewed`); None: of no input.
        linear: inputs that go straight from a row to the next; the others are held.
        share: of the way from held (0) to linear (1), per input, of those in `linear`; None: all of it.

    Returns:
        The values at beginning, middle and end of every substep (K = 3) where an input is linear; else, K = 1, the mean, which
        is held over it.
    """
    if half_play is not None:
        u = play(u, half_play)
    part = jnp.ones(u.shape[1], u.dtype) if share is None else share
    if slowness is not None:
        lines = jnp.array([float(i in linear) for i in range(u.shape[1])], u.dtype)
        u = slewed(u, slowness, dt, lines * part if linear else None)
    rows = u.shape[0] - bool(linear)
    before = jnp.concatenate([jnp.repeat(u[:1], lead, axis=0), u])  # before the record the first input was held
    near = before[jnp.arange(rows)[:, None] + jnp.arange(lead + 1 + bool(linear))[None]]
    order = jnp.arange(1, rows * substeps + 1, dtype=u.dtype)
    # how many rows the end of every substep lies behind each of the rows near it; whole numbers and fractions, no floor: two
    # compiled loops may round a quotient to two sides of a row, and read one sample with the weight of another
    back = jnp.arange(lead, -1 - bool(linear), -1, dtype=u.dtype)[None]
    back = back + (jnp.arange(substeps + 1, dtype=u.dtype) / substeps)[:, None]

    def weighed(weight: Array, near: Array) -> Array:
        return jnp.dot(near, weight.T, precision=jax.lax.Precision.HIGHEST).reshape(-1)

    def held(near: Array, passed: Array) -> Array:
        weight = jnp.diff(_ramp(passed), axis=0) * substeps
        return weighed(_complete(weight, 1.0), near)  # later than all that is known: the oldest

    def straight(near: Array, passed: Array) -> tuple[Array, Array]:
        mean, rise = _hats(passed, substeps)
        return weighed(_complete(mean, 1.0), near), weighed(_complete(rise, 0.0), near)

    def lagged(mean: Array, rise: Array, tau: Array) -> tuple[Array, Array]:
        """Return the exact answer of the lag to straight lines, as lines: mean and rise of every substep."""
        ratio = dt / substeps / (tau + 1e-15 * dt / substeps)
        keep = jnp.exp(-ratio)
        settled = mean - rise / 2 - rise / ratio  # the particular solution at the beginning of a substep

        def join(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
            return a[0] * b[0], a[1] * b[0] + b[1]

        _, ends = jax.lax.associative_scan(join, (jnp.full_like(mean, keep), (1 - keep)[None] * settled + rise))
        first = mean[:1] - rise[:1] / 2  # settled before the record
        ends = ends + jnp.exp(-ratio[None] * order) * first
        begin = jnp.concatenate([first, ends[:-1]])
        fading = begin - settled
        turn = 12 * ((1 - keep) / ratio**2 - (1 + keep) / (2 * ratio))  # rise of exp(-t/tau), by its first moment
        return mean - rise / ratio + fading * ((1 - keep) / ratio)[None], rise + fading * turn[None]

    def one_held(near: Array, d: Array, tau: Array) -> Array:
        mean = held(near, back[:, : lead + 1] - d / dt)
        return lagged(mean, jnp.zeros_like(mean), tau)[0]

    def one_linear(near: Array, d: Array, tau: Array, part: Array) -> Array:
        passed = back - d / dt
        mean, rise = straight(near, passed)
        stairs = held(near[:, : lead + 1], passed[:, : lead + 1])
        mean, rise = lagged(stairs + part * (mean - stairs), part * rise, tau)
        return jnp.stack([mean + at * rise for at in STAGES])

    if not linear:
        every = jax.vmap(one_held, in_axes=(2, 0, 0), out_axes=1)(near, delay, lag)
        return every.reshape(rows, substeps, 1, -1)[lead:]
    columns = [
        one_linear(near[..., i], delay[i], lag[i], part[i])
        if i in linear
        else jnp.broadcast_to(one_held(near[:, : lead + 1, i], delay[i], lag[i]), (len(STAGES), rows * substeps))
        for i in range(u.shape[1])
    ]
    return jnp.moveaxis(jnp.stack(columns, axis=-1), 0, 1).reshape(rows, substeps, len(STAGES), -1)[lead:]


def prompt_inputs(u: Float[Array, "rows nu"], substeps: int, linear: Sequence[int]) -> Float[Array, "substeps K nu"]:
    """Return what `delayed_inputs` does of one row, exactly, where nothing is late.

    Args:
        u: inputs of the row and, where one is linear, of the row after it.
        substeps: per row.
        linear: inputs that go straight from a row to the next; the others are held.
    """
    if not linear:
        return jnp.broadcast_to(u[:1][None], (substeps, 1, u.shape[1]))
    shares = (jnp.arange(substeps, dtype=u.dtype)[:, None] + jnp.array([[0.0, 0.5, 1.0]], u.dtype)) / substeps
    step = jnp.stack([u[1, i] - u[0, i] if i in linear else jnp.zeros((), u.dtype) for i in range(u.shape[1])])
    return u[:1][None] + shares[..., None] * step[None, None]


def _complete(weight: Float[Array, "substeps near"], total: float) -> Float[Array, "substeps near"]:
    """Give the oldest row what the weights of a substep lack."""
    return weight.at[:, 0].add(total - jnp.sum(weight, axis=1))


def _hats(passed: Float[Array, "ends near"], substeps: int) -> tuple[Array, Array]:
    """Return mean and rise, over every substep, of the hat function about every row; the rise keeps the first moment.

    Args:
        passed: rows that lie between the row and the end of every substep, and the beginning of the first.
        substeps: per row.
    """
    area, twice = _areas(passed)
    h = 1 / substeps
    moment = h / 2 * (area[1:] + area[:-1]) - jnp.diff(twice, axis=0)
    return jnp.diff(area, axis=0) / h, 12 * moment / h**2


def _areas(t: Array) -> tuple[Array, Array]:
    """Return the integral of the hat function about 0, and that of the integral."""
    up, down = _ramp(t + 1), _ramp(t)
    area = up**2 / 2 + down - down**2 / 2
    return area, up**3 / 6 + down / 2 + down**2 / 2 - down**3 / 6 + jnp.maximum(t - 1, 0.0)


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


def slewed(
    u: Float[Array, "R nu"], slowness: Float[Array, " nu"], dt: float, linear: Float[Array, " nu"] | None = None
) -> Float[Array, "R nu"]:
    """Return what an actuator makes of its commands that follows them no faster than at a largest rate.

        dv/dt = sign(u - v)/s while v is not u yet;   v = u at the first row

    Of a command that is held, the mean over its row, which moves a velocity by as much as the way there does; of one that goes
    straight from row to row, where it is at the row.

    Args:
        u: commands, row by row.
        slowness: s, time for one unit of u, s per unit, per input; 0 = follows at once.
        dt: distance of the rows, s.
        linear: share of the way from held (0) to linear (1), per input; None: all are held.

    Reference: Astrom and Rundqwist (1989), Integrator windup and how to avoid it, American Control Conference (actuators that
    saturate in rate).
    """

    def row(carry: tuple[Array, Array], now: Array) -> tuple[tuple[Array, Array], Array]:
        far, behind = now - carry[0], now - carry[1]
        rows = jnp.abs(far) * slowness / dt  # that the way takes
        late = jnp.abs(behind) * slowness / dt
        left, late = 1 - 1 / jnp.maximum(rows, 1.0), 1 - 1 / jnp.maximum(late, 1.0)  # of the way, after a row
        mean = now - far * jnp.where(rows <= 1, rows / 2, (1 + left) / 2)
        at_row = now - behind * late
        out = mean if linear is None else mean + linear * (at_row - mean)
        return (now - far * left, at_row), out

    return jax.lax.scan(row, (u[0], u[0]), u)[1]
