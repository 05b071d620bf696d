"""What one unit of a parameter adds to rates and readings along a track, at all rows at once (`pushes`).

Slopes are worked out at the stages of the integrator, only in the parameters that move, each for the hypotheses that move it;
`tangents` says what follows from them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from simpel_cli.dynamics.input_delay import as_read
from simpel_cli.dynamics.late_readings import shares
from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.clock import chosen, early_of
from simpel_cli.filtering.likelihood.derivatives import RATES, SENSORS, Differentiated, Slopes, differentiated
from simpel_cli.filtering.likelihood.sensor_delay import JUMPS, back, of_rates, shares_of, still_shown
from simpel_cli.filtering.likelihood.small_matrices import apart, applied, sure_of, where_asked
from simpel_cli.filtering.likelihood.track import Held, Pushes, Track, Ways
from simpel_cli.runs.settings import current_device

SMALL = 3  # states of a model whose covariance follows the parameters
# of the rates' slopes along a track that are read at once, for every direction: more do not fit a cache
NUMBERS = 32768


class Timing(NamedTuple):
    """When inputs and readings of an augmented model act.

    Args:
        dt: s.
        substeps: Runge-Kutta steps per row.
        inputs: (p, u) -> inputs as they arrive, (T, substeps, K, nu, ...).
        of_inputs: rows of p that say when an input arrives.
        late_by: p -> delay and lag of every sensor, (ny, ...) each; None: no sensor is late.
        linear: inputs that go straight from a row to the next.
        parts: of a row, between which an input may arrive.
        overshoots: whether a held input may arrive within one of them.
    """

    dt: float
    substeps: int
    inputs: Callable[[Array, Array], Array]
    of_inputs: Sequence[int]
    late_by: Callable[[Array], tuple[Array, Array]] | None
    linear: tuple[int, ...]
    parts: int
    overshoots: bool


def pushes_of(augmented: Augmented, timing: Timing) -> Callable[..., tuple[Ways, Pushes]]:
    """Return `pushes` of a filter (see `Filter`)."""
    nx, nu = len(augmented.model.states), len(augmented.model.inputs)
    rates, sensors = differentiated(augmented, RATES), differentiated(augmented, SENSORS)
    bend = differentiated(augmented, RATES, slope=True) if nx <= SMALL else None
    dt, substeps, late_by = timing.dt, timing.substeps, timing.late_by

    def pushes(p: Array, rows: Array, at: Track, held: Held, u: Array) -> tuple[Ways, Pushes]:
        sure = sure_of(at.variance)
        units = jax.vmap(lambda row: _unit(p, row))(_at_each(rows, p))
        asked = moved = moved_before = None
        if timing.of_inputs:
            asked = jnp.isin(rows, jnp.array(timing.of_inputs)).reshape(len(rows), -1).any(axis=1)

            def arriving(direction: tuple[Array, Array]) -> Array:
                ask, unit = direction
                along = lambda unit: jax.jvp(lambda q: timing.inputs(q, u)[:, :, :, :nu], (p,), (unit,))[1]  # noqa: E731
                return where_asked(ask, along, unit)

            moved = jnp.moveaxis(_of_each(arriving, (asked, units), _count(rows, p)), 1, 0)
            seen_moved = as_read(moved, timing.linear, 3)  # (T, D, substeps, K, nu, ...)
            moved_before = jnp.concatenate([seen_moved[:1, :, 0, 0], seen_moved[:-1, :, -1, -1]])
        at_rows = lambda a: jnp.expand_dims(a, a.ndim - p.ndim + 1)  # noqa: E731
        late = None if late_by is None else jax.tree.map(at_rows, (late_by(p), _along(late_by, p, units)))
        acts = as_read(held.u, timing.linear, 2)
        before = jnp.concatenate([acts[:1, 0, 0], acts[:-1, -1, -1]])[:, :nu]

        def of(part: tuple[Any, ...]) -> tuple[Ways, Pushes, Array | None]:
            """Rows are points like others: their axis goes in front of those of the points, and back."""
            found = _of_rows(
                at_rows(p), rows, asked, late, sure, *jax.tree.map(lambda a: jnp.moveaxis(a, 0, -p.ndim), part)
            )
            return jax.tree.map(lambda a: jnp.moveaxis(a, -p.ndim, 0), found)

        size = max(1, NUMBERS // (nx**2 * 3 * substeps * at.predicted[0, 0].size))
        ways, found, within = _in_parts(of, (at.predicted, held, before, moved, moved_before), size)
        if within is not None:
            found = found._replace(reading=found.reading + _since(within))
        if found.bent is not None:
            assert bend is not None
            start = _pushed(bend, p, at.predicted[0], before[0], asked)
            first = None if moved_before is None else moved_before[0]
            begin = _of_each(lambda each: start(*each), (rows, asked, first), _count(rows, p))
            found = found._replace(bent=jnp.concatenate([begin.reshape(1, *found.bent.shape[1:]), found.bent[:-1]]))
        return ways, found

    def _of_rows(
        p: Array, rows: Array, asked: Array | None, late: Any, sure: Array, predicted: Array, held: Held, before: Array,
        moved: Any, moved_before: Any,
    ) -> tuple[Ways, Pushes, Array | None]:  # fmt: skip
        """Do so for rows, the first axis of the points; `moved`: (D, substeps, K, nu, ...) how the inputs change.

        Behind them: what the readings in the rows to come show of jumps within this one, (D, JUMPS, ny, ...).
        """
        u = held.u[:, _stages_of(held.u.shape[1])]  # (substeps, 3, nu, ...)
        x_s, u_s = jnp.moveaxis(held.stages, 2, 0), jnp.moveaxis(u[:, :, :nu], 2, 0)
        acts = as_read(held.u, timing.linear, 1)[:, :, :nu]
        moved_s = seen_moved = None
        if moved is not None:
            moved_s = jnp.moveaxis(moved[:, :, _stages_of(moved.shape[2])], 3, 1)
            seen = as_read(moved, timing.linear, 2)
            seen_moved = jnp.stack([seen[:, 0, 0], seen[:, -1, -1]], axis=2)  # (D, nu, 2, ...)
        by_x = jnp.moveaxis(held.stage_x, (2, 3), (0, 1))
        h = dt / substeps if held.pace is None else dt / substeps * held.pace[None]
        early = early_of(held.u[0, 0], nu)
        begin = predicted, acts[0, 0]
        moves = late is not None or early is not None
        # what the rates are at the beginning of the row is asked among their stages: their program is a large one. So is what
        # they are at both ends where, as a stage, the line of an input that arrives overshoots
        also = [begin, *([(x_s[:, 0, 0], acts[0, 0]), (x_s[:, -1, -1], acts[-1, -1])] if timing.overshoots else [])]
        every_x, every_u = (
            _side_by_side(a, jnp.stack(points, axis=1) if moves else None)
            for a, points in zip((x_s, u_s), zip(*also, strict=True), strict=True)
        )
        push_of = _pushed(rates, p, every_x, every_u, asked)
        reading_of = _pushed(sensors, p, *begin, asked)
        first = now = end = None
        if moves:
            first, now, end = by_x[:, :, 0, 0], _slopes(rates, p, *begin).by_x, by_x[:, :, -1, -1]
        then_of = None if early is None else _pushed(sensors, p, predicted, before, asked)
        ends_u = jnp.stack([acts[0, 0], acts[-1, -1]], axis=1)
        turned_of = None if bend is None else _pushed(bend, p, _ends(x_s), ends_u, asked)
        held_ones = jnp.array([i for i in range(nu) if i not in timing.linear], int)
        arrives = jnp.any(u_s[held_ones, :, 2] != u_s[held_ones, :, 0], axis=(0, 1))
        if late is not None:
            some_late = jnp.any(late[0][0] > 0) | jnp.any(late[0][1] > 0)
            some_jump = jnp.any(acts[1:, 0] != acts[:-1, -1])

            rings = _rings(*late[0]) if timing.parts > 1 else None

        def shown(late: tuple[Array, Array]) -> Array:
            assert held.jumps is not None
            smooth = jnp.sum(held.prompt * back(*late, held.motion), axis=1)
            return smooth + still_shown(shares_of(*late, len(held.jumps), dt, timing.parts), held.jumps)

        def one(direction: tuple[Any, ...]) -> tuple[Pushes, Array | None]:
            row, ask, moved, moved_ends, moved_before, slower = direction
            at_first = None if moved_ends is None else moved_ends[:, 0]
            along = None if moved_ends is None or not moves else moved_ends[:, jnp.array([0, 0, 1][: len(also)])]
            every = push_of(row, ask, None if moved is None else _side_by_side(moved, along))
            push = every[:, : 3 * substeps].reshape(nx, substeps, 3, *every.shape[2:])
            reading = reading_of(row, ask, at_first)
            if then_of is not None and early is not None:
                reading = chosen(early, then_of(row, ask, moved_before), reading)
            within = None
            if late is not None:
                asks = jnp.any(slower[0] != 0) | jnp.any(slower[1] != 0)
                reading = reading + where_asked(asks, lambda d: jax.jvp(shown, (late[0],), (d,))[1], slower)
                if rings is not None:
                    jumps = some_jump if ask is None else some_jump | ask
                    # in the middle of its line an input that arrives is its mean
                    mean = arrives
                    if ask is not None and moved is not None:
                        mean = mean | (ask & jnp.any(moved[held_ones, :, 2] != moved[held_ones, :, 0], axis=(0, 1)))
                    begins, ends = (jnp.where(mean, push[:, :, 1], push[:, :, k]) for k in (0, 2))
                    change = jnp.moveaxis(begins[:, 1:] - ends[:, :-1], 1, 0)
                    show = lambda change: _still_to_be_shown(rings, held.prompt, change, by_x[:, :, -1, -1])  # noqa: E731
                    within = where_asked(some_late & jumps, show, change)
            turn = bent = None
            if turned_of is not None:
                turned = turned_of(row, ask, moved_ends)
                square = turned.reshape(nx, nx, *turned.shape[1:])
                turn, bent = (square[:, :, 0] + square[:, :, 1]) / 2, None if early is None else square[:, :, 1]
            end = _composed(by_x, push, h, sure)
            if not moves:
                return Pushes(end, reading, None, None, None, turn, bent), within
            outer = (every[:, -2], every[:, -1]) if timing.overshoots else (push[:, 0, 0], push[:, -1, -1])
            return Pushes(end, reading, outer[0], every[:, 3 * substeps], outer[1], turn, bent), within

        directions = (rows, asked, moved_s, seen_moved, moved_before, None if late is None else late[1])
        found, within = _of_each(one, directions, _count(rows, p))
        turn = None
        if bend is not None:
            turn = _slopes(bend, p, _ends(x_s), ends_u).by_x
            turn = turn.reshape(nx, nx, nx, *turn.shape[2:])
        return Ways(first, now, end, turn), found, within

    def _rings(d: Array, tau: Array) -> Array:
        """Return what the next rows still show of jumps between the substeps of this one, (JUMPS, substeps - 1, ...)."""
        ago = dt / substeps * jnp.arange(substeps - 1, 0, -1, dtype=d.dtype)  # at the end of the row
        return jnp.stack([shares(d, tau, ago + k * dt) for k in range(JUMPS)])

    def _still_to_be_shown(rings: Array, prompt: Array, change: Array, rate_x: Array) -> Array:
        """Return what is shown in the next rows, (JUMPS, ny, ...), where the rates jump between the substeps of this one."""
        jumps = of_rates(prompt, change, rate_x)
        return jnp.stack([still_shown(ring, jumps) for ring in rings])

    return pushes


def _since(within: Array) -> Array:
    """Return what every row shows of those before it, (T, D, ny, ...).

    Args:
        within: what each row shows later, (T, D, JUMPS, ny, ...).
    """
    total = jnp.zeros_like(within[:, :, 0])
    for k in range(JUMPS):
        back = k + 1
        total = total + jnp.concatenate([jnp.zeros_like(within[:back, :, k]), within[:-back, :, k]])[: len(total)]
    return total


def _slopes(of: Differentiated, p: Array, x: Array, u: Array) -> Slopes:
    """Slopes at points (nx, ...), (nu, ...), the last axes of which p has."""
    return of.slopes(x, u, jnp.broadcast_to(_beside(p, x), (len(p), *x.shape[1:])))


def _pushed(
    of: Differentiated, p: Array, x: Array, u: Array, asked: Array | None
) -> Callable[[Array, Array | None, Array | None], Array]:
    """Return what a direction adds at such points: (its row, whether inputs move in it, how, (nu, ...)) -> (n, ...).

    Args:
        of: the function.
        p: parameters.
        x: states.
        u: inputs.
        asked: (D,) whether inputs move in a direction; None: they never do.
    """
    along = _along_rows(of, x, u, _beside(p, x))
    if asked is None:
        return lambda row, ask, moved: along(row)
    by_u = where_asked(asked.any(), lambda: _slopes(of, p, x, u).by_u)

    def one(row: Array, ask: Array | None, moved: Array | None) -> Array:
        assert ask is not None
        return along(row) + where_asked(ask, lambda moved: applied(by_u, moved), moved)

    return one


def _beside(p: Array, x: Array) -> Array:
    return p.reshape(len(p), *(1,) * (x.ndim - p.ndim), *p.shape[1:])


def _along_rows(of: Differentiated, x: Array, u: Array, p: Array) -> Callable[[Array], Array]:
    """Return derivatives in p[row], (n, ...), of a row, or of (L,) rows of which each is for a part of the last axis.

    The points of a part share their parameters.
    """
    if current_device().platform != "cpu":  # there a branch would wait for the host
        table = of.every(x, u, p)
        return lambda row: _picked(table, of.place(row))

    def along(row: Array) -> Array:
        if row.size == 1:
            return of.along(row.reshape(()), x, u, p[..., :1] if row.ndim else p)
        cut = [a.reshape(*a.shape[:-1], len(row), a.shape[-1] // len(row)) for a in (x, u, p)]
        cut[2] = cut[2][..., :1]  # numbers: what is made of them alone is made once

        def one(at: tuple[Array, Array]) -> Array:
            row, part = at
            return of.along(row, *(jax.lax.dynamic_index_in_dim(a, part, a.ndim - 2, keepdims=False) for a in cut))

        found = jnp.moveaxis(jax.lax.map(one, (row, jnp.arange(len(row)))), 0, -2)
        return found.reshape(*found.shape[:-2], x.shape[-1])

    return along


def _of_each(function: Callable[[Any], Any], directions: Any, count: Array) -> Any:
    """Apply a function of a direction to the first ones, of which each moves something; of the others: zeros."""
    if current_device().platform != "cpu":
        return jax.vmap(function)(directions)
    shapes = jax.eval_shape(function, jax.tree.map(lambda a: a[0], directions))
    total = len(jax.tree.leaves(directions)[0])

    def one(i: Array, found: Any) -> Any:
        new = function(jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, i, keepdims=False), directions))
        return jax.tree.map(lambda a, b: jax.lax.dynamic_update_index_in_dim(a, b, i, 0), found, new)

    nothing = jax.tree.map(lambda a: jnp.zeros((total, *a.shape), a.dtype), shapes)
    return jax.lax.fori_loop(0, count, one, nothing)


def _count(rows: Array, p: Array) -> Array:
    """Return how many directions there are up to the last one that moves something."""
    moves = (rows < len(p)).reshape(len(rows), -1).any(axis=1)
    return jnp.max(jnp.where(moves, jnp.arange(1, len(rows) + 1), 0))


def _picked(table: Array, row: Array) -> Array:
    """Return the entry of a table, (J, n, ...), that stands in a row, or in (L,), each for a part of the last axis."""
    if row.ndim == 0:
        return table[row]
    cut = table.reshape(*table.shape[:-1], len(row), table.shape[-1] // len(row))
    found = jax.vmap(lambda part, row: part[row], in_axes=(-2, 0), out_axes=-2)(cut, row)
    return found.reshape(*found.shape[:-2], table.shape[-1])


def _stages_of(count: int) -> Array:
    """Return where the beginning, the middle and the end of a substep stand among its inputs."""
    return jnp.array([0, count // 2, count - 1])


def _side_by_side(stages: Array, more: Array | None) -> Array:
    """Return the stages of a row, (n, substeps, 3, ...), one after the other, and more points behind them, (n, k, ...)."""
    # n is 0 where there are no inputs: the size is said
    flat = stages.reshape(stages.shape[0], stages.shape[1] * stages.shape[2], *stages.shape[3:])
    return flat if more is None else jnp.concatenate([flat, more], axis=1)


def _ends(a: Array) -> Array:
    """Return the beginning and the end of a row; a: (n, substeps, 3, ...)."""
    return jnp.stack([a[:, 0, 0], a[:, -1, -1]], axis=1)


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


def _in_parts(function: Callable[[Any], Any], rows: Any, size: int) -> Any:
    """Apply a function of rows, which lead, to so many at once."""
    count = len(jax.tree.leaves(rows)[0])
    parts = -(-count // size)
    if parts == 1:
        return function(rows)
    size = -(-count // parts)
    filled = jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], parts * size - count, axis=0)]), rows)
    cut = jax.tree.map(lambda a: a.reshape(parts, size, *a.shape[1:]), filled)
    found = jax.lax.map(function, cut)
    return jax.tree.map(lambda a: a.reshape(parts * size, *a.shape[2:])[:count], found)
