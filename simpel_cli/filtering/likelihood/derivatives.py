"""A model's functions with their derivative in the state, and what they do when the state or one parameter moves.

Left to itself, XLA works out every sine anew for every direction of a derivative. Here CasADi differentiates, the
derivatives are made once per point, and a direction costs a few products with the structural nonzeros.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from simpel_cli.dynamics.casadi_jax import checked, to_jax_rows
from simpel_cli.filtering.likelihood.augmented import Augmented


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


Slope = Callable[[Array, Array, Array], tuple[Array, Array]]
Value = Callable[[Array, Array, Moving], Array]
NAMES = ["x", "u", "p"]


def with_slope(augmented: Augmented, of: int) -> Slope:
    """Return (x, u, p) -> one result of the model's function, (n, ...), and its derivative in x, (n, nx, ...).

    Args:
        augmented: model with candidates.
        of: 0 for the rates, 1 for the sensors.
    """
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    result = augmented.function(x, u, p)[of]
    n, nx = result.numel(), x.numel()
    values = casadi.densify(casadi.vertcat(result, casadi.vec(casadi.jacobian(result, x).T)))
    model = augmented.model
    ranges = [[(q.low, q.high) for q in group] for group in (model.states, model.inputs, augmented.params)]
    both = casadi.Function("both", [x, u, p], casadi.cse([values]), NAMES, ["v"])
    checked(both, ranges)
    # jit within jit: the lists of instructions are walked once, not in every program that uses them
    every = jax.jit(to_jax_rows(both))

    def at(x: Array, u: Array, p: Array) -> tuple[Array, Array]:
        v = every(x, u, p)[0]
        return v[:n], _finite(v[n:]).reshape(n, nx, *v.shape[1:])

    return at


def movable(augmented: Augmented, of: int, *, slope: bool = False) -> Value:
    """Return (x, u, moving) -> one result of the model's function, (n, ...), to be differentiated along a direction.

    Args:
        augmented: model with candidates.
        of: 0 for the rates, 1 for the sensors.
        slope: return its derivative in x instead, row by row, (n nx, ...).
    """
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    result = augmented.function(x, u, p)[of]
    result = casadi.densify(casadi.vec(casadi.jacobian(result, x).T) if slope else result)
    in_x, in_u, in_p = (casadi.jacobian(result, v) for v in (x, u, p))
    blocks = _blocks(_places(in_p))
    in_p = casadi.vertcat(*(casadi.vec(casadi.densify(in_p[b.rows, b.columns]).T) for b in blocks))
    own = _finite if slope else lambda v: v
    plain = jax.jit(to_jax_rows(casadi.Function("value", [x, u, p], casadi.cse([result]), NAMES, ["v"])))
    slopes = casadi.cse([result, in_x, in_u, in_p])
    every = to_jax_rows(casadi.Function("slopes", [x, u, p], slopes, NAMES, ["v", "by_x", "by_u", "by_p"]))

    @jax.jit
    def all_of(x: Array, u: Array, p: Array) -> tuple[Array, ...]:
        v, *slopes = every(x, u, p)
        return own(v), *map(_finite, slopes)

    places_x, places_u = _places(in_x), _places(in_u)

    @jax.custom_jvp
    def value(x: Array, u: Array, p: Array, row: Array, moving: Array) -> Array:
        return own(plain(x, u, p)[0])

    @value.defjvp
    def _(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        x, u, p, row, _ = primals
        tx, tu, _, _, moved_by = tangents
        # without the barrier XLA fuses the expressions into every direction, and works them out again for each
        v, by_x, by_u, by_p = jax.lax.optimization_barrier(all_of(x, u, p))
        sums: list[Any] = [0.0] * v.shape[0]
        for places, slope, tangent in ((places_x, by_x, tx), (places_u, by_u, tu)):
            for k, (i, j) in enumerate(places):
                sums[i] = sums[i] + slope[k] * tangent[j]
        begin = 0
        for block in blocks:
            shape = len(block.rows), len(block.columns)
            table = by_p[begin : begin + shape[0] * shape[1]].reshape(*shape, *p.shape[1:])
            begin += shape[0] * shape[1]
            place = np.full(p.shape[0] + 1, -1)  # the last one is the padding, which moves nothing
            place[block.columns] = np.arange(shape[1])
            at = jnp.asarray(place)[jnp.minimum(row, p.shape[0])]
            column = jnp.take_along_axis(table, jnp.maximum(at, 0)[None, None], axis=1)[:, 0]
            step = jnp.where(at >= 0, moved_by, 0.0)
            for k, i in enumerate(block.rows):
                sums[i] = sums[i] + column[k] * step
        return v, jnp.stack([jnp.broadcast_to(s, v.shape[1:]) for s in sums])

    return lambda x, u, given: value(x, u, jax.lax.stop_gradient(given.p), given.row, given.value)


def _finite(slopes: Array) -> Array:
    """The slope of sqrt(max(h, 0)) at an empty tank is infinite or nan: there it counts as zero."""
    return jnp.where(jnp.isfinite(slopes), slopes, 0.0)


class _Block(NamedTuple):
    """Parameters that act on the same results."""

    rows: list[int]
    columns: list[int]


def _blocks(places: list[tuple[int, int]]) -> list[_Block]:
    """Gather parameters by the results that they act on: most act on one, and all other rows would be zeros."""
    rows_of: dict[int, set[int]] = {}
    for i, j in places:
        rows_of.setdefault(j, set()).add(i)
    groups: dict[frozenset[int], list[int]] = {}
    for j, rows in sorted(rows_of.items()):
        groups.setdefault(frozenset(rows), []).append(j)
    return [_Block(sorted(rows), columns) for rows, columns in groups.items()]


def _places(matrix: casadi.SX) -> list[tuple[int, int]]:
    """Row and column of every structural nonzero, in CasADi's order."""
    sparsity = matrix.sparsity()
    rows, columns = sparsity.row(), np.repeat(np.arange(matrix.shape[1]), np.diff(sparsity.colind()))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True)]
