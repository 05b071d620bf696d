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
    """Derivatives of n results of a function at points, the trailing axes: in the states and in the inputs."""

    by_x: Float[Array, "n nx ..."]
    by_u: Float[Array, "n nu ..."]


class Differentiated(NamedTuple):
    """A function and its derivatives.

    Args:
        slopes: (x, u, p) -> Slopes, where x, u and p are (nx, ...), (nu, ...) and (dp, ...) at the same points.
        every: (x, u, p) -> derivatives in all parameters that move the results, and zeros.
        place: row of p -> its place among them.
        along: (row, x, u, p) -> derivative in p[row], (n, ...); one beyond the last row of p: 0. p may lack axes of the points.
    """

    slopes: Callable[[Array, Array, Array], Slopes]
    every: Callable[[Array, Array, Array], Float[Array, "J n ..."]]
    place: Callable[[Int[Array, "..."]], Int[Array, "..."]]
    along: Callable[[Int[Array, ""], Array, Array, Array], Float[Array, "n ..."]]


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
    outs = [casadi.densify(casadi.vec(casadi.jacobian(result, v).T)) for v in (x, u)]
    program = jax.jit(to_jax_rows(casadi.Function("slopes", [x, u, p], casadi.cse(outs), NAMES, ["by_x", "by_u"])))
    in_p = casadi.jacobian(result, p)
    n, nx, nu = result.numel(), x.numel(), u.numel()

    def slopes(x: Array, u: Array, p: Array) -> Slopes:
        by_x, by_u = (_finite(a) for a in program(x, u, p))
        points = x.shape[1:]
        return Slopes(by_x.reshape(n, nx, *points), by_u.reshape(n, nu, *points))

    # one branch per parameter: of a hundred a fit moves a few, and a table of all would be most of its work
    moving = [j for j in range(p.numel()) if in_p[:, j].nnz()]
    branches = [_column(casadi.cse([in_p[:, j]]), (x, u, p)) for j in moving]
    place = np.full(p.numel() + 1, len(moving))
    place[moving] = np.arange(len(moving))

    branches.append(lambda x, u, p: jnp.zeros((n, *x.shape[1:]), x.dtype))

    def places(rows: Array) -> Array:
        return jnp.asarray(place)[rows]

    def every(x: Array, u: Array, p: Array) -> Array:
        return jnp.stack([branch(x, u, p) for branch in branches])

    def along(row: Array, x: Array, u: Array, p: Array) -> Array:
        return jax.lax.switch(places(row), branches, x, u, p)

    return Differentiated(slopes, every, places, along)


def _column(result: list[casadi.SX], arguments: tuple[casadi.SX, ...]) -> Callable[[Array, Array, Array], Array]:
    """Return (x, u, p) -> a column of a Jacobian, (n, ...), of which most entries are zeros."""
    (column,) = result
    there = column.sparsity().row()
    program = to_jax_rows(casadi.Function("column", [*arguments], [casadi.densify(column[there])], NAMES, ["v"]))

    def at(x: Array, u: Array, p: Array) -> Array:
        everywhere = jnp.broadcast_to(p, (len(p), *x.shape[1:]))
        found = dict(zip(there, _finite(program(x, u, everywhere)[0]), strict=True))
        return jnp.stack([found.get(i, jnp.zeros(x.shape[1:], x.dtype)) for i in range(column.numel())])

    return at


def _symbols(augmented: Augmented) -> tuple[casadi.SX, casadi.SX, casadi.SX]:
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    return x, u, p


def _finite(slopes: Array) -> Array:
    """The slope of sqrt(max(h, 0)) at an empty tank is infinite or nan: there it counts as zero."""
    return jnp.where(jnp.isfinite(slopes), slopes, 0.0)
