"""Derivatives of innovations and variances along a track of the filter: in the levels of noise, and in parameters.

Along a known track all that moves is linear. What one unit of a parameter adds to rates and readings is worked out at all
rows at once (`pushes.py`). What that leads to is a recursion of small products (`slopes`),

    de = -(H d + reading),             d+ = d + K de + dP+ H' e/R,            d_next  = F d+ + state
    dP+ = (I - K H) dP (I - K H)' + K dR K',    dP_next = F dP+ F' + dF P+ F' + F P+ dF' + dQ

since the gain K is optimal: its own change drops out of dP+. A level of noise is followed exactly and, in a small model, a
parameter, for which the Jacobian F of a row follows to second order in dt. A large model holds its gains where a parameter
moves, as the innovations form of a prediction-error method does.

Of what a late sensor reads, the slope A of the rates is held, and with it the rest of the third order: up to a tenth of a
derivative (`tests/filtering/test_tangents.py`). That does not bias the fit of a model that is right: what is left at its true
parameters is noise, whatever it is weighed with, as with instruments in place of slopes (Ljung 1999, ch. 7.6). Of a model that
lacks something the optimum moves a little.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8 (the filter's equations, linearised); Ljung
(1999), System identification, ch. 7.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.clock import early_of
from simpel_cli.filtering.likelihood.covariances import counted, of_half_a_row, of_row
from simpel_cli.filtering.likelihood.early_values import slope_back, way_back
from simpel_cli.filtering.likelihood.pushes import SMALL, Timing
from simpel_cli.filtering.likelihood.sensor_delay import JUMPS, Motion, back, moving, pushed, shares_of, still_shown
from simpel_cli.filtering.likelihood.small_matrices import apart, applied, product, sure_of
from simpel_cli.filtering.likelihood.track import Held, Noise, Pushes, Track, Ways


class _Rows(NamedTuple):
    """Rows of a track, which lead, with what follows of a change there; `step`: from the row before, s."""

    at: Track
    held: Held
    counted: tuple[Array, Array]
    ways: Ways
    step: Array | None


class _Moved(NamedTuple):
    """Derivatives of what goes from row to row; (): not followed.

    Args:
        state: (nx, ...).
        cov: (nx, nx, ...).
        motion: at the end of the row before.
        jumps: of what the sensors read, at rows; those within rows are in the pushes.
        begin: state and rate at the row before.
        bent: slope of the rates at the end of the row before, as far as the state there moves it.
    """

    state: Array
    cov: Any
    motion: Any
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
        late = None if late_by is None else (*(by := late_by(p)), shares_of(*by, JUMPS, dt))
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
        begun = None if push is None else jax.tree.map(lambda a: a[0], push)
        rate = nothing if begun is None or begun.now is None else begun.now
        motion: Any = ()
        if rows.ways.now is not None:
            motion = _moving(rate, rows.ways.now[0], begun, None if rows.held.pace is None else rows.held.pace[0])
        uneven = rows.step is not None
        return _Moved(
            nothing,
            square if follows else (),
            motion,
            () if rows.held.jumps is None else jnp.zeros_like(rows.held.jumps[0, :JUMPS]),
            (-dt * rate, rate) if uneven else (),
            square if uneven and rows.ways.turn is not None else (),
        )

    def _after_row(
        moved: _Moved,
        row: _Rows,
        push: Pushes | None,
        late: tuple[Array, Array, Array] | None,
        half: Array,
        of_r: Array | None,
        of_half: Array | None,
        sure: Array,
    ) -> tuple[_Moved, tuple[Array, Array]]:
        state, cov, motion, jumps, begin, bent = moved
        at, held, (ok, larger), ways, step = row
        early, follows = early_of(held.u[0, 0], nu), not isinstance(cov, tuple)
        read = applied(held.prompt, state)
        if push is not None:
            read = read + push.reading
        if early is not None:
            read = read + jnp.sum(held.prompt * way_back(early, state, motion.rate, (*begin, _there(step))), axis=1)
        if late is not None:
            assert ways.now is not None
            d, tau, shares = late
            read = read + jnp.sum(held.prompt * back(d, tau, motion), axis=1) + still_shown(shares, jumps)
            now = applied(ways.now, state)
            now = now if push is None or push.now is None else now + push.now
            jumps = pushed(jumps, held.prompt, motion, _moving(now, ways.now, push, held.pace))
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
            motion = _moving(rate, ways.end, push, held.pace)
        return _Moved(end, cov, motion, jumps, begin, bent), (jnp.stack(of_e), jnp.stack(of_s))

    def _moving(rate: Array, rate_x: Array, push: Pushes | None, pace: Array | None) -> Motion:
        """Return how the motion changes where its rates do.

        What a push adds to the rates' rates beside inputs that rise is by how much it grows in the row; else it is held.
        """
        if not (timing.linear and push is not None and push.first is not None):
            return moving(rate, rate_x)
        step = dt if pace is None else dt * pace[None]
        return moving(rate, rate_x, (_there(push.end) - push.first) / step)

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


def _turned_back(early: Array, prompt: Array, rate_x: Array, bent: Array) -> Array:
    """How the slope of what was read before its row changes as that of the rates does."""
    return jax.jvp(lambda a: slope_back(early, prompt, a), (rate_x,), (bent,))[1]
