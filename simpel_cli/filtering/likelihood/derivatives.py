"""A model's functions at many points at once, with their derivatives in the state, the inputs and every parameter.

CasADi differentiates: left to itself, XLA works out every sine anew for every direction of a derivative.
"""

from collections.abc import Callable
from typing import NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from simpel_cli.dynamics.casadi_jax import checked, to_jax_rows
from simpel_cli.filtering.likelihood.augmented import Augmented

NAMES = ["x", "u", "p"]
RATES, SENSORS = 0, 1  # results of a model's function


class Slopes(NamedTuple):
    """Derivatives of n results of a function at points, the trailing axes.

    Args:
        by_x: in the states.
        by_u: in the inputs.
        by_p: in the parameters, those that act on the same results in one table.
    """

    by_x: Float[Array, "n nx ..."]
    by_u: Float[Array, "n nu ..."]
    by_p: tuple[Float[Array, "rows columns ..."], ...]


class Differentiated(NamedTuple):
    """A function and its derivatives.

    Args:
        slopes: (x, u, p) -> Slopes, where x, u and p are (nx, ...), (nu, ...) and (dp, ...) at the same points.
        along: (slopes, row) -> derivative in p[row], (n, ...); row: (...) at the last axes of the points, one beyond the last
            row of p: 0.
    """

    slopes: Callable[[Array, Array, Array], Slopes]
    along: Callable[[Slopes, Int[Array, "..."]], Float[Array, "n ..."]]


def value(augmented: Augmented, of: int) -> Callable[[Array, Array, Array], Array]:
    """Return (x, u, p) -> one result of the model's function, (n, ...); of: RATES or SENSORS."""
    x, u, p = _symbols(augmented)
    result = casadi.cse([casadi.densify(augmented.function(x, u, p)[of])])
    program = jax.jit(to_jax_rows(casadi.Function("value", [x, u, p], result, NAMES, ["v"])))
    return lambda x, u, p: program(x, u, p)[0]


def with_slope(augmented: Augmented, of: int) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """Return (x, u, p) -> one result of the model's function, (n, ...), and its derivative in x, (n, nx, ...).

    Args:
        augmented: model with candidates.
        of: RATES or SENSORS.
    """
    x, u, p = _symbols(augmented)
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


def differentiated(augmented: Augmented, of: int, *, slope: bool = False) -> Differentiated:
    """Return the derivatives of one result of the model's function.

    Args:
        augmented: model with candidates.
        of: RATES or SENSORS.
        slope: of its derivative in x instead, row by row: n nx results.
    """
    x, u, p = _symbols(augmented)
    result = augmented.function(x, u, p)[of]
    result = casadi.densify(casadi.vec(casadi.jacobian(result, x).T) if slope else result)
    in_x, in_u, in_p = (casadi.jacobian(result, v) for v in (x, u, p))
    blocks = _blocks(in_p.sparsity())
    tables = [casadi.vec(casadi.densify(in_p[b.rows, b.columns]).T) for b in blocks]
    outs = [*(casadi.densify(casadi.vec(a.T)) for a in (in_x, in_u)), *tables]
    names = [f"o{k}" for k in range(len(outs))]
    program = jax.jit(to_jax_rows(casadi.Function("slopes", [x, u, p], casadi.cse(outs), NAMES, names)))
    n, nx, nu, dp = result.numel(), x.numel(), u.numel(), p.numel()

    def slopes(x: Array, u: Array, p: Array) -> Slopes:
        by_x, by_u, *by_p = (_finite(a) for a in program(x, u, p))
        points = x.shape[1:]
        tables = (a.reshape(len(b.rows), len(b.columns), *points) for a, b in zip(by_p, blocks, strict=True))
        return Slopes(by_x.reshape(n, nx, *points), by_u.reshape(n, nu, *points), tuple(tables))

    def along(slopes: Slopes, row: Array) -> Array:
        points = slopes.by_x.shape[2:]
        rows: list[Array] = [jnp.zeros(points, slopes.by_x.dtype)] * n
        wide = row.reshape(*(1,) * (len(points) - row.ndim), *row.shape)
        for block, table in zip(blocks, slopes.by_p, strict=True):
            place = np.full(dp + 1, -1)  # a row beyond the last moves nothing
            place[block.columns] = np.arange(len(block.columns))
            at = jnp.asarray(place)[jnp.minimum(wide, dp)]
            column = jnp.take_along_axis(table, jnp.maximum(at, 0)[None, None], axis=1)[:, 0]
            for k, i in enumerate(block.rows):
                rows[i] = rows[i] + jnp.where(at >= 0, column[k], 0.0)
        return jnp.stack(rows)

    return Differentiated(slopes, along)


def _symbols(augmented: Augmented) -> tuple[casadi.SX, casadi.SX, casadi.SX]:
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    return x, u, p


def _finite(slopes: Array) -> Array:
    """The slope of sqrt(max(h, 0)) at an empty tank is infinite or nan: there it counts as zero."""
    return jnp.where(jnp.isfinite(slopes), slopes, 0.0)


class _Block(NamedTuple):
    """Parameters that act on the same results."""

    rows: list[int]
    columns: list[int]


def _blocks(sparsity: casadi.Sparsity) -> list[_Block]:
    """Gather parameters by the results that they act on: most act on one, and all other rows would be zeros."""
    columns = np.repeat(np.arange(sparsity.size2()), np.diff(sparsity.colind())).tolist()
    rows_of: dict[int, set[int]] = {}
    for i, j in zip(sparsity.row(), columns, strict=True):
        rows_of.setdefault(j, set()).add(i)
    groups: dict[frozenset[int], list[int]] = {}
    for j, rows in sorted(rows_of.items()):
        groups.setdefault(frozenset(rows), []).append(j)
    return [_Block(sorted(rows), columns) for rows, columns in groups.items()]
