"""Derivatives of innovations and variances along a track of the filter: in the levels of noise, and in parameters.

Along a known track all that moves is linear. What one unit of a parameter adds to rates and readings is worked out at all
rows at once, at the stages of the integrator (`pushes`). What that leads to is a recursion of small products (`slopes`),

    de = -(H d + reading),             d+ = d + K de + dP+ H' e/R,            d_next  = F d+ + state
    dP+ = (I - K H) dP (I - K H)' + K dR K',    dP_next = F dP+ F' + dF P+ F' + F P+ dF' + dQ

since the gain K is optimal: its own change drops out of dP+. A level of noise is followed exactly and, in a small model, a
parameter, for which the Jacobian F of a row follows to second order in dt. A large model holds its gains where a parameter
moves, as the innovations form of a prediction-error method does.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8 (the filter's equations, linearised); Ljung
(1999), System identification, ch. 7.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.clock import chosen, early_of
from simpel_cli.filtering.likelihood.covariances import counted, of_half_a_row, of_row
from simpel_cli.filtering.likelihood.derivatives import RATES, SENSORS, Differentiated, Slopes, differentiated
from simpel_cli.filtering.likelihood.early_values import slope_back, way_back
from simpel_cli.filtering.likelihood.sensor_delay import back, echo, pushed
from simpel_cli.filtering.likelihood.small_matrices import apart, applied, product, sure_of
from simpel_cli.filtering.likelihood.track import Held, Noise, Pushes, Track, Ways
from simpel_cli.runs.settings import current_device

SMALL = 3  # states of a model whose covariance follows the parameters
POINTS = 8192  # at which derivatives are worked out at once: more do not fit a cache


class Timing(NamedTuple):
    """When inputs and readings of an augmented model act.

    Args:
        dt: s.
        substeps: Runge-Kutta steps per row.
        inputs: (p, u) -> inputs as they arrive, (T, substeps, K, nu, ...).
        of_inputs: rows of p that say when an input arrives.
        late_by: p -> delay and lag of every sensor, (ny, ...) each; None: no sensor is late.
    """

    dt: float
    substeps: int
    inputs: Callable[[Array, Array], Array]
    of_inputs: Sequence[int]
    late_by: Callable[[Array], tuple[Array, Array]] | None


class _Rows(NamedTuple):
    """Rows of a track, which lead, with what follows of a change there; `step`: from the row before, s."""

    at: Track
    held: Held
    counted: tuple[Array, Array]
    ways: Ways
    step: Array | None


def pushes_of(augmented: Augmented, timing: Timing) -> Callable[..., tuple[Ways, Pushes]]:
    """Return `pushes` of a filter (see `Filter`)."""
    nx, nu = len(augmented.model.states), len(augmented.model.inputs)
    rates, sensors = differentiated(augmented, RATES), differentiated(augmented, SENSORS)
    bend = differentiated(augmented, RATES, slope=True) if nx <= SMALL else None
    dt, substeps, late_by = timing.dt, timing.substeps, timing.late_by

    def pushes(p: Array, rows: Array, at: Track, held: Held, u: Array) -> tuple[Ways, Pushes]:
        sure = sure_of(at.variance)
        units = jax.vmap(lambda row: _unit(p, row))(_at_each(rows, p))
        moved = moved_before = None
        asked = jnp.asarray(False)
        if timing.of_inputs:
            asked = jnp.isin(rows, jnp.array(timing.of_inputs)).any()
            moved = jnp.moveaxis(
                _if(asked, lambda: _along(lambda q: timing.inputs(q, u)[:, :, :, :nu], p, units)), 1, 0
            )
            moved_before = jnp.concatenate([moved[:1, :, 0, 0], moved[:-1, :, -1, -1]])
        at_rows = lambda a: jnp.expand_dims(a, a.ndim - p.ndim + 1)  # noqa: E731
        late = None if late_by is None else jax.tree.map(at_rows, (late_by(p), _along(late_by, p, units)))
        before = jnp.concatenate([held.u[:1, 0, 0], held.u[:-1, -1, -1]])[:, :nu]

        def of(part: tuple[Any, ...]) -> tuple[Ways, Pushes]:
            """Rows are points like others: their axis goes in front of those of the points, and back."""
            found = _of_rows(
                at_rows(p), rows, asked, late, sure, *jax.tree.map(lambda a: jnp.moveaxis(a, 0, -p.ndim), part)
            )
            return jax.tree.map(lambda a: jnp.moveaxis(a, -p.ndim, 0), found)

        size = max(1, POINTS // (3 * substeps * at.predicted[0, 0].size))
        ways, found = _in_parts(of, (at.predicted, held, before, moved, moved_before), size)
        if found.bent is not None:
            assert bend is not None
            begin = at.predicted[0], before[0], None if moved_before is None else moved_before[0]
            start = _pushed(bend, p, rows, *begin, asked)
            found = found._replace(bent=jnp.concatenate([start.reshape(1, *found.bent.shape[1:]), found.bent[:-1]]))
        return ways, found

    def _of_rows(
        p: Array, rows: Array, asked: Array, late: Any, sure: Array, predicted: Array, held: Held, before: Array, moved: Any,
        moved_before: Any,
    ) -> tuple[Ways, Pushes]:  # fmt: skip
        """Do so for rows, the first axis of the points; `moved`: (D, substeps, K, nu, ...) how the inputs change."""
        u = held.u[:, _stages_of(held.u.shape[1])]  # (substeps, 3, nu, ...)
        x_s, u_s = jnp.moveaxis(held.stages, 2, 0), jnp.moveaxis(u[:, :, :nu], 2, 0)
        moved_s = None
        if moved is not None:
            moved_s = jnp.moveaxis(moved[:, :, _stages_of(moved.shape[2])], 3, 1)
        push = _pushed(rates, p, rows, x_s, u_s, moved_s, asked)
        by_x = jnp.moveaxis(held.stage_x, (2, 3), (0, 1))
        h = dt / substeps if held.pace is None else dt / substeps * held.pace[None]
        state = jax.vmap(lambda g: _composed(by_x, g, h, sure))(push)

        first_of = lambda a: None if a is None else a[:, :, 0, 0]  # noqa: E731
        early = early_of(held.u[0, 0], nu)
        first = now = end = push_first = push_now = push_end = None
        if late is not None or early is not None:
            begin = predicted, u_s[:, 0, 0]
            push_now = _pushed(rates, p, rows, *begin, first_of(moved_s), asked)
            first, now, end = by_x[:, :, 0, 0], _slopes(rates, p, *begin).by_x, by_x[:, :, -1, -1]
            push_first, push_end = push[:, :, 0, 0], push[:, :, -1, -1]
        reading = _pushed(sensors, p, rows, predicted, u_s[:, 0, 0], first_of(moved_s), asked)
        if early is not None:
            then = _pushed(sensors, p, rows, predicted, before, moved_before, asked)
            reading = jax.vmap(lambda a, b: chosen(early, a, b))(then, reading)
        if late is not None:

            def shown(late: tuple[Array, Array]) -> Array:
                assert held.rate is not None
                assert held.jumps is not None
                return jnp.sum(held.prompt * back(*late, held.rate, held.rate_x), axis=1) + echo(*late, held.jumps, dt)

            reading = reading + jax.vmap(lambda d: jax.jvp(shown, (late[0],), (d,))[1])(late[1])

        turn = push_turn = push_bent = None
        if bend is not None:
            moved_ends = None if moved_s is None else jax.vmap(_ends)(moved_s)
            turned = _pushed(bend, p, rows, _ends(x_s), _ends(u_s), moved_ends, asked)
            squares = turned.reshape(len(rows), nx, nx, *turned.shape[2:])
            turn = _slopes(bend, p, _ends(x_s), _ends(u_s)).by_x
            turn = turn.reshape(nx, nx, nx, *turn.shape[2:])
            push_turn = (squares[:, :, :, 0] + squares[:, :, :, 1]) / 2
            push_bent = squares[:, :, :, 1] if early is not None else None
        return Ways(first, now, end, turn), Pushes(state, reading, push_first, push_now, push_end, push_turn, push_bent)

    return pushes


class _Moved(NamedTuple):
    """Derivatives of what goes from row to row; (): not followed.

    Args:
        state: (nx, ...).
        cov: (nx, nx, ...).
        rate: at the end of the row before.
        jumps: of what the sensors read.
        begin: state and rate at the row before.
        bent: slope of the rates at the end of the row before, as far as the state there moves it.
    """

    state: Array
    cov: Any
    rate: Any
    jumps: Any
    begin: Any
    bent: Any


def slopes_of(augmented: Augmented, timing: Timing) -> Callable[..., tuple[Array, Array]]:
    """Return `slopes` of a filter (see `Filter`)."""
    nx, ny, nu = len(augmented.model.states), len(augmented.measured), len(augmented.model.inputs)
    dt, late_by = timing.dt, timing.late_by

    def slopes(
        p: Array, noise: Noise, louder: Noise, at: Track, held: Held, ok: Array, ways: Ways, pushes: Pushes
    ) -> tuple[Array, Array]:
        late = None if late_by is None else late_by(p)
        rows = _Rows(at, held, counted(ok), ways, None if held.pace is None else _shifted(dt * held.pace, dt))
        half, sure = of_half_a_row(noise.q, dt), sure_of(noise.r)

        def along(louder: Noise | None, push: Pushes | None) -> tuple[Array, Array]:
            """Derivatives in one direction: of the noise, or along a push."""
            of_r, of_half = None, None
            if louder is not None:
                of_r = 2 * noise.r * louder.r
                of_half = jax.jvp(lambda q: of_half_a_row(q, dt), (noise.q,), (louder.q,))[1]

            def row(moved: _Moved, data: tuple[_Rows, Pushes | None]) -> tuple[_Moved, tuple[Array, Array]]:
                return _after_row(moved, *data, late, half, of_r, of_half, sure)

            return jax.lax.scan(row, _first(rows, push, follows=push is None or nx <= SMALL), (rows, push))[1]

        loud, pushed = (
            jax.vmap(lambda each: along(each, None))(louder),
            jax.vmap(lambda each: along(None, each), in_axes=1)(pushes),
        )
        return jnp.concatenate([loud[0], pushed[0]]), jnp.concatenate([loud[1], pushed[1]])

    def _first(rows: _Rows, push: Pushes | None, *, follows: bool) -> _Moved:
        """The first row lies where the window begins, at rest."""
        nothing = jnp.zeros_like(rows.at.mean[0])
        square = jnp.zeros_like(rows.at.jacobian[0])
        rate = nothing if push is None or push.now is None else push.now[0]
        uneven = rows.step is not None
        return _Moved(
            nothing,
            square if follows else (),
            rate if rows.ways.now is not None else (),
            () if rows.held.jumps is None else jnp.zeros_like(rows.held.jumps[0]),
            (-dt * rate, rate) if uneven else (),
            square if uneven and rows.ways.turn is not None else (),
        )

    def _after_row(
        moved: _Moved,
        row: _Rows,
        push: Pushes | None,
        late: tuple[Array, Array] | None,
        half: Array,
        of_r: Array | None,
        of_half: Array | None,
        sure: Array,
    ) -> tuple[_Moved, tuple[Array, Array]]:
        state, cov, rate, jumps, begin, bent = moved
        at, held, (ok, larger), ways, step = row
        early, follows = early_of(held.u[0, 0], nu), not isinstance(cov, tuple)
        read = applied(held.prompt, state)
        if push is not None:
            read = read + push.reading
        if early is not None:
            read = read + jnp.sum(held.prompt * way_back(early, state, rate, (*begin, _there(step))), axis=1)
        if late is not None:
            assert ways.now is not None
            read = read + jnp.sum(held.prompt * back(*late, rate, held.rate_x), axis=1) + echo(*late, jumps, dt)
            now = applied(ways.now, state)
            jumps = pushed(jumps, held.prompt, rate, now if push is None or push.now is None else now + push.now)
        turned = None
        if early is not None and ways.turn is not None and follows:
            bent = bent if push is None or push.bent is None else bent + push.bent
            turned = _turned_back(early, held.prompt, held.rate_x, bent)
        predicted, learned, known, of_e, of_s = state, jnp.zeros_like(state), at.predicted_cov, [], []
        for j in range(ny):
            c, gain, e, s = at.slope[j], held.gain[j], at.innovation[j], at.variance[j]
            de = -read[j] - product(c[None], (state - predicted)[:, None])[0, 0]
            ds = jnp.zeros_like(e) if of_r is None else of_r[j] * larger[j]
            if turned is not None:
                de = de - product(turned[j][None], learned[:, None])[0, 0]
                learned = learned + gain * e[None]
            if follows:
                # v = d(P c); the gain is optimal, so that its own change drops out:
                # dP+ = dP - v g' - g v' + g g' ds
                v = apart(sure, applied, cov, c)
                ds = ds + product(c[None], v[:, None])[0, 0]
                if turned is not None:
                    reach, more = applied(known, c), product(known, turned[j][:, None])[:, 0]
                    v, ds = v + more, ds + 2 * product(c[None], more[:, None])[0, 0]
                    known = known - gain[:, None] * reach[None]
                state, cov = apart(sure, _after_reading, state, cov, gain, de, ds, v, ok[j] * e / s)
            else:
                state = state + gain * de[None]
            of_e.append(de)
            of_s.append(ds)
        end = applied(at.jacobian, state)
        end = end if push is None else end + push.state
        if follows:
            jacobian, noisy = at.jacobian, cov if of_half is None else cov + of_row(of_half, held.pace)
            reached = apart(sure, product, jacobian, noisy)
            cov = product(reached, jnp.swapaxes(jacobian, 0, 1))
            cov = cov if of_half is None else cov + of_row(of_half, held.pace)
            if ways.turn is not None:
                firsts, ends = (
                    jnp.sum(ways.turn[:, :, :, k] * x[None, None], axis=2) for k, x in ((0, state), (1, end))
                )
                change = (firsts + ends) / 2
                change = change if push is None or push.turn is None else change + push.turn
                change = change * (dt / 2 if held.pace is None else dt / 2 * held.pace[None, None])
                carried = product(at.cov + of_row(half, held.pace), jnp.swapaxes(jacobian, 0, 1))
                bending = apart(sure, _both_ways, jacobian, change)
                one = product(bending, carried)
                cov = cov + one + jnp.swapaxes(one, 0, 1)
                if early is not None:
                    bent = ends
        if ways.first is not None:
            assert ways.end is not None
            firsts, rate = applied(ways.first, state), applied(ways.end, end)
            if push is not None and push.first is not None:
                firsts, rate = firsts + push.first, rate + _there(push.end)
            begin = begin if early is None else (state, firsts)
        return _Moved(end, cov, rate, jumps, begin, bent), (jnp.stack(of_e), jnp.stack(of_s))

    return slopes


def _after_reading(
    state: Array, cov: Array, gain: Array, de: Array, ds: Array, v: Array, surprise: Array
) -> tuple[Array, Array]:
    """Return how a reading moves the change of the state and of its covariance."""
    both = gain[:, None] * (v - gain * (ds / 2)[None])[None]
    state = state + gain * de[None] + (v - gain * ds[None]) * surprise[None]
    return state, cov - both - jnp.swapaxes(both, 0, 1)


def _both_ways(a: Array, b: Array) -> Array:
    return product(a, b) + product(b, a)


def _there(value: Array | None) -> Array:
    """Return what is there wherever something else is."""
    assert value is not None
    return value


def _shifted(pace: Array, first: float) -> Array:
    """Return the step from the row before, s."""
    return jnp.concatenate([jnp.full_like(pace[:1], first), pace[:-1]])


def _slopes(of: Differentiated, p: Array, x: Array, u: Array) -> Slopes:
    """Slopes at points (nx, ...), (nu, ...), the last axes of which p has."""
    return of.slopes(x, u, jnp.broadcast_to(_beside(p, x), (len(p), *x.shape[1:])))


def _pushed(of: Differentiated, p: Array, rows: Array, x: Array, u: Array, moved: Array | None, asked: Array) -> Array:
    """Return what every direction adds, (D, n, ...), at such points.

    Args:
        of: the function.
        p: parameters.
        rows: directions (see `Filter`).
        x: states.
        u: inputs.
        moved: (D, nu, ...) how these change; None: they do not.
        asked: whether they do in any direction.
    """
    found = _along_rows(of, rows, x, u, _beside(p, x))
    if moved is None:
        return found

    def by_inputs() -> Array:
        by_u = _slopes(of, p, x, u).by_u
        return jax.vmap(lambda d: applied(by_u, d))(moved)

    return found + _if(asked, by_inputs)


def _beside(p: Array, x: Array) -> Array:
    return p.reshape(len(p), *(1,) * (x.ndim - p.ndim), *p.shape[1:])


def _along_rows(of: Differentiated, rows: Array, x: Array, u: Array, p: Array) -> Array:
    """Derivatives in p[row] for each of rows, (D, n, ...), or (D, L) of which each is for a part of the last axis.

    The points of a part share their parameters.
    """
    if current_device().platform != "cpu":  # there a branch would wait for the host
        return _picked(of.every(x, u, p), of.place(rows))
    if rows.ndim == 1:
        return jax.lax.map(lambda row: of.along(row, x, u, p), rows)
    parts = rows.shape[1]
    given = [jnp.moveaxis(a.reshape(*a.shape[:-1], parts, a.shape[-1] // parts), -2, 0) for a in (x, u, p)]
    given[2] = given[2][..., :1]  # numbers: what is made of them alone is made once

    def one(at: tuple[Array, Array]) -> Array:
        row, part = at
        return of.along(row, *(jax.lax.dynamic_index_in_dim(a, part, keepdims=False) for a in given))

    which = jnp.broadcast_to(jnp.arange(parts), rows.shape)
    found = jax.lax.map(one, (rows.ravel(), which.ravel()))
    found = jnp.moveaxis(found.reshape(*rows.shape, *found.shape[1:]), 1, -2)
    return found.reshape(*found.shape[:-2], x.shape[-1])


def _picked(table: Array, rows: Array) -> Array:
    """Return the entries of a table, (J, n, ...), that stand in rows, (D,), or (D, L), each for a part of the last axis."""
    if rows.ndim == 1:
        return table[rows]
    cut = table.reshape(*table.shape[:-1], rows.shape[1], table.shape[-1] // rows.shape[1])
    found = jax.vmap(lambda part, row: part[row], in_axes=(-2, 1), out_axes=-2)(cut, rows)
    return found.reshape(*found.shape[:-2], table.shape[-1])


def _stages_of(count: int) -> Array:
    """Return where the beginning, the middle and the end of a substep stand among its inputs."""
    return jnp.array([0, count // 2, count - 1])


def _ends(a: Array) -> Array:
    """Return the beginning and the end of a row; a: (n, substeps, 3, ...)."""
    return jnp.stack([a[:, 0, 0], a[:, -1, -1]], axis=1)


def _turned_back(early: Array, prompt: Array, rate_x: Array, bent: Array) -> Array:
    """How the slope of what was read before its row changes as that of the rates does."""
    return jax.jvp(lambda a: slope_back(early, prompt, a), (rate_x,), (bent,))[1]


def _composed(by_x: Array, push: Array, h: Array | float, sure: Array) -> Array:
    """Return what a push of the rates, (nx, substeps, 3, ...), leads to at the end of the row: the integrator's derivative."""

    def step(moved: Array, now: tuple[Array, Array]) -> tuple[Array, None]:
        a, g = now

        def rate(k: int, x: Array) -> Array:
            return apart(sure, applied, a[:, :, k], x) + g[:, k]

        k1 = rate(0, moved)
        k2 = rate(1, moved + h / 2 * k1)
        k3 = rate(1, moved + h / 2 * k2)
        k4 = rate(2, moved + h * k3)
        return moved + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    start = jnp.zeros((push.shape[0], *push.shape[3:]), push.dtype)
    return jax.lax.scan(step, start, (jnp.moveaxis(by_x, 2, 0), jnp.moveaxis(push, 1, 0)))[0]


def _at_each(rows: Array, p: Array) -> Array:
    """Return the row of every direction at every point, (D, ...)."""
    if rows.ndim == 1:
        return jnp.broadcast_to(rows.reshape(-1, *(1,) * (p.ndim - 1)), (len(rows), *p.shape[1:]))
    return jnp.repeat(rows, p.shape[-1] // rows.shape[1], axis=1)


def _unit(p: Array, row: Array) -> Array:
    """Return the direction in which one parameter moves, (dp, ...); row: (...)."""
    return (jnp.arange(len(p)).reshape(-1, *(1,) * row.ndim) == row[None]).astype(p.dtype)


def _along(function: Callable[[Array], Any], p: Array, units: Array) -> Any:
    """Derivatives of a function of the parameters in every direction."""
    return jax.vmap(lambda unit: jax.jvp(function, (p,), (unit,))[1])(units)


def _if(asked: Array, worked_out: Callable[[], Array]) -> Array:
    """Zeros where it is not asked for."""
    shape = jax.eval_shape(worked_out)
    return jax.lax.cond(asked, worked_out, lambda: jnp.zeros(shape.shape, shape.dtype))


def _in_parts(function: Callable[[Any], Any], rows: Any, size: int) -> Any:
    """Apply a function of rows, which lead, to so many at once."""
    count = len(jax.tree.leaves(rows)[0])
    parts = -(-count // size)
    if parts == 1:
        return function(rows)
    size = -(-count // parts)
    filled = jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], parts * size - count, axis=0)]), rows)
    apart = jax.tree.map(lambda a: a.reshape(parts, size, *a.shape[1:]), filled)
    found = jax.lax.map(function, apart)
    return jax.tree.map(lambda a: a.reshape(parts * size, *a.shape[2:])[:count], found)
