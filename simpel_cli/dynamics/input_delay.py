"""Inputs as they arrive: through a play, at a limited rate, as they are between rows, delayed and lagged, over substeps.

A held input is a staircase; the mean over a substep that lies d in the past is a sum over samples, each weighted with the
share of the substep that it fills: continuous in d, below one sample too. A linear or smooth input is such a sum of other
kernels (`between_rows.py`). Over a substep an input is taken for the straight line that has its mean and its first moment, a
smooth one for the parabola that is where it is at the beginning, in the middle and at the end. Where a held one arrives within
a substep, the mean alone would say how far a speed moves and not when, which a position shows: an integrator of second order
has the line's answer exactly. What is read goes by the mean (`as_read`), since at its ends the line overshoots the step.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.dynamics.between_rows import KERNELS, REACH, begun_smoothly, beyond
from simulators.quantity import HELD, LINEAR, SMOOTH

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
    smooth: Sequence[int] = (),
    way: Float[Array, " nu"] | None = None,
    rising: bool = True,
    ranges: Sequence[tuple[float, float]] = (),
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
        linear: inputs that move from a row to the next, straight where nothing else is said; the others are held.
        smooth: those of them that are smooth curves through their rows.
        way: from held (0) over linear (1/2) to smooth (1), per input, of those in `linear`; None: as the words say.
        rising: whether a held input may arrive within a substep; else it is held over it, at its mean.
        ranges: that inputs keep to, per input, where they were given no value beyond it; none: they may be anything.

    Returns:
        The values at beginning, middle and end of every substep (K = 3) where an input is linear or may rise; else, K = 1, the
        mean, which is held over it.
    """
    if half_play is not None:
        u = play(u, half_play)
    if slowness is not None:
        straight = jnp.array([float(i in linear) for i in range(u.shape[1])], u.dtype)
        straight = straight if way is None else straight * jnp.minimum(2 * way, 1.0)
        u = slewed(u, slowness, dt, straight if linear else None)
    rows = u.shape[0] - bool(linear)
    most = SMOOTH if smooth or way is not None else LINEAR if linear else HELD
    past, ahead = REACH[most]
    behind = lead + past  # rows near a row that have a share in it

    def nearby(u: Array) -> Array:
        """Return the rows near every row; before the record the first input was held."""
        before = jnp.concatenate([jnp.repeat(u[:1], lead, axis=0), u])
        for _ in range(past):  # what is beyond both ends matters to the first and the last rows only
            before = jnp.concatenate([beyond(before[::-1])[None], before, beyond(before)[None]])
        return before[jnp.arange(rows)[:, None] + jnp.arange(behind + 1 + ahead)[None]]

    near = nearby(u)
    near_curve = nearby(begun_smoothly(u, lead, past)) if past else near
    order = jnp.arange(1, rows * substeps + 1, dtype=u.dtype)
    # how many rows the end of every substep lies behind each of the rows near it; whole numbers and fractions, no floor: two
    # compiled loops may round a quotient to two sides of a row, and read one sample with the weight of another
    back = jnp.arange(behind, -1 - ahead, -1, dtype=u.dtype)[None]
    back = back + (jnp.arange(substeps + 1, dtype=u.dtype) / substeps)[:, None]

    def weighed(weight: Array, near: Array) -> Array:
        return jnp.dot(near, weight.T, precision=jax.lax.Precision.HIGHEST).reshape(-1)

    def line(word: str, near: Array, passed: Array, *, rises: bool) -> tuple[Array, Array]:
        """Return mean and rise over every substep."""
        mean, rise = KERNELS[word].shares(passed)
        mean = weighed(_complete(mean, 1.0), near)  # later than all that is known: the oldest
        return mean, weighed(_complete(rise, 0.0), near) if rises else jnp.zeros_like(mean)

    def lagged(mean: Array, rise: Array, tau: Array) -> tuple[Array, Array]:
        """Return the exact answer of the lag to straight lines, as lines: mean and rise of every substep."""
        slow = tau / (dt / substeps) + 1e-15  # in substeps; powers of its reciprocal have no derivative in float32
        keep = jnp.exp(-1 / slow)
        settled = mean - rise / 2 - rise * slow  # the particular solution at the beginning of a substep

        def join(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
            return a[0] * b[0], a[1] * b[0] + b[1]

        _, ends = jax.lax.associative_scan(join, (jnp.full_like(mean, keep), (1 - keep)[None] * settled + rise))
        first = mean[:1] - rise[:1] / 2  # settled before the record
        ends = ends + jnp.exp(-order / slow[None]) * first
        begin = jnp.concatenate([first, ends[:-1]])
        fading = begin - settled
        turn = 12 * slow * ((1 - keep) * slow - (1 + keep) / 2)  # rise of exp(-t/tau), by its first moment
        return mean - rise * slow + fading * ((1 - keep) * slow)[None], rise + fading * turn[None]

    low, high = (
        jnp.repeat(_ends(near, [r[k] for r in ranges], k), substeps, axis=0) for k in (0, 1)
    )  # of every substep

    def one_held(near: Array, d: Array, tau: Array, low: Array, high: Array) -> Array:
        mean, rise = lagged(*line(HELD, near, back - d / dt, rises=rising), tau)
        if not rising:
            return mean[None]
        if ranges:
            most = jnp.maximum(2 * jnp.minimum(mean - low, high - mean), 0.0)
            rise = jnp.clip(rise, -most, most)
        return jnp.stack([mean + at * rise for at in STAGES])

    def one_moving(i: int, d: Array, tau: Array) -> Array:
        passed = back - d / dt
        parts = {SMOOTH if i in smooth else LINEAR: jnp.ones((), u.dtype)}
        if way is not None:
            w = 2 * way[i]
            parts = {HELD: jnp.maximum(1 - w, 0.0), LINEAR: 1 - jnp.abs(w - 1), SMOOTH: jnp.maximum(w - 1, 0.0)}
        rows_of = {word: (near_curve if word == SMOOTH else near)[..., i] for word in parts}
        # while it is asked whether it is held, it is the mean: a line that overshoots would be taken for a straight input
        lines = {word: line(word, rows_of[word], passed, rises=word != HELD) for word in parts}
        found = [sum((parts[word] * lines[word][k] for word in parts), jnp.zeros(())) for k in (0, 1)]
        mean, rise = lagged(found[0], found[1], tau)
        stages = jnp.stack([mean + at * rise for at in STAGES])
        if SMOOTH not in parts:
            return stages
        # a curve is no line: where it is at the stages, whose Simpson sum is its mean; what lags is a line nearly
        at_stages = passed[:-1], (passed[:-1] + passed[1:]) / 2, passed[1:]
        curve = [weighed(_complete(KERNELS[SMOOTH].values(t), 1.0), rows_of[SMOOTH]) for t in at_stages]
        off = [c - (lines[SMOOTH][0] + at * lines[SMOOTH][1]) for c, at in zip(curve, STAGES, strict=True)]
        prompt = 1 - jnp.exp(-dt / substeps / (tau + 1e-15 * dt / substeps))
        return stages + parts[SMOOTH] * prompt * jnp.stack(off)

    if not linear:
        every = jax.vmap(one_held, in_axes=(2, 0, 0, 1, 1), out_axes=2)(near, delay, lag, low, high)
    else:
        held = [i for i in range(u.shape[1]) if i not in linear]
        columns = {i: one_held(near[..., i], delay[i], lag[i], low[:, i], high[:, i]) for i in held}
        columns |= {i: one_moving(i, delay[i], lag[i]) for i in linear}
        shape = (len(STAGES), rows * substeps)
        every = jnp.stack([jnp.broadcast_to(columns[i], shape) for i in range(u.shape[1])], axis=2)
    if ranges:  # beyond it a root or a logarithm may not be defined: not even by what was rounded
        every = jnp.where(every < low[None], low[None], jnp.where(every > high[None], high[None], every))
    return jnp.moveaxis(every, 0, 1).reshape(rows, substeps, every.shape[0], -1)[lead:]


def _ends(near: Array, declared: Sequence[float], side: int) -> Array:
    """Return the lowest (0) or highest (1) value of the inputs near every row, (rows, nu): as declared, or given beyond it."""
    of = (jnp.min, jnp.max)[side](near, axis=1)
    return (jnp.minimum, jnp.maximum)[side](of, jnp.array(declared, near.dtype)[None]) if len(declared) else of


def as_read(u: Array, linear: Sequence[int], axis: int = 2) -> Array:
    """Return inputs of substeps (.., K, nu, ..) as readings go by them: what is held is its mean over a substep.

    What is returned has K = 1 where no input is linear.

    Args:
        u: as of `delayed_inputs`.
        linear: inputs that move from a row to the next.
        axis: of K; that of the inputs stands behind it.
    """
    count = u.shape[axis]
    middle = jax.lax.slice_in_dim(u, count // 2, count // 2 + 1, axis=axis)
    if count == 1 or not linear:
        return middle
    moves = jnp.isin(jnp.arange(u.shape[axis + 1]), jnp.array(list(linear)))
    return jnp.where(moves.reshape(-1, *(1,) * (u.ndim - axis - 2)), u, middle)


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
