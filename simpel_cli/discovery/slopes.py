"""A model's functions with their derivative in the state, and what both do when the state or one parameter moves.

Left to itself, XLA works out every sine anew for every direction of a derivative. Here CasADi differentiates twice, the
derivatives are made once per point, and a direction costs a few products with the structural nonzeros.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.casadi_jax import checked, to_jax_rows
from simpel_cli.discovery.augmented import Augmented

if TYPE_CHECKING:
    from simpel_cli.discovery.filter import Moving

Slope = Callable[[Array, Array, "Moving"], tuple[Array, Array]]


def with_slope(augmented: Augmented, of: int) -> Slope:
    """Return (x, u, moving) -> one result of the model's function, (n, ...), and its derivative in x, (n, nx, ...).

    Args:
        augmented: model with candidates.
        of: 0 for the rates, 1 for the sensors.
    """
    x, u, p = (augmented.function.sx_in(i) for i in range(3))
    result = augmented.function(x, u, p)[of]
    n, nx = result.numel(), x.numel()
    values = casadi.densify(casadi.vertcat(result, casadi.vec(casadi.jacobian(result, x).T)))
    in_x, in_u, in_p = (casadi.jacobian(values, v) for v in (x, u, p))
    moved = sorted(set(in_p.sparsity().row()))  # the rows of `values` that parameters change at all
    in_p = casadi.densify(in_p[moved, :]) if moved else casadi.SX(0, p.numel())
    names = ["x", "u", "p"]
    ranges = [
        [(q.low, q.high) for q in group] for group in (augmented.model.states, augmented.model.inputs, augmented.params)
    ]
    checked(casadi.Function("value", [x, u, p], casadi.cse([values]), names, ["v"]), ranges)
    # jit within jit: the lists of instructions are walked once, not in every program that uses them
    value = jax.jit(to_jax_rows(casadi.Function("value", [x, u, p], casadi.cse([values]), names, ["v"])))
    slopes = [values, in_x, in_u, casadi.vec(in_p.T)]
    with_all = casadi.Function("slopes", [x, u, p], casadi.cse(slopes), names, ["v", "by_x", "by_u", "by_p"])
    all_of = jax.jit(to_jax_rows(with_all))
    places_x, places_u = _places(in_x), _places(in_u)

    @jax.custom_jvp
    def flat(x: Array, u: Array, p: Array, row: Array, moving: Array) -> Array:
        return value(x, u, p)[0]

    @flat.defjvp
    def _(primals: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        x, u, p, row, _ = primals
        tx, tu, _, _, moved_by = tangents
        # without the barrier XLA fuses the expressions into every direction, and works them out again for each
        v, by_x, by_u, by_p = jax.lax.optimization_barrier(all_of(x, u, p))
        sums: list[Any] = [0.0] * len(values.nonzeros())
        for places, slope, tangent in ((places_x, by_x, tx), (places_u, by_u, tu)):
            for k, (i, j) in enumerate(places):
                sums[i] = sums[i] + slope[k] * tangent[j]
        if moved:
            # beyond the last row: the padding, which moves nothing
            table = by_p.reshape(len(moved), p.shape[0], *p.shape[1:])
            column = jnp.take_along_axis(table, jnp.minimum(row, p.shape[0] - 1)[None, None], axis=1)[:, 0]
            step = jnp.where(row < p.shape[0], moved_by, 0.0)
            for k, i in enumerate(moved):
                sums[i] = sums[i] + column[k] * step
        return v, jnp.stack([jnp.broadcast_to(s, v.shape[1:]) for s in sums])

    def point(x: Array, u: Array, given: "Moving") -> tuple[Array, Array]:
        v = flat(x, u, jax.lax.stop_gradient(given.p), given.row, given.value)
        return v[:n], v[n:].reshape(n, nx, *v.shape[1:])

    return point


def _places(matrix: casadi.SX) -> list[tuple[int, int]]:
    """Row and column of every structural nonzero, in CasADi's order."""
    sparsity = matrix.sparsity()
    rows, columns = sparsity.row(), np.repeat(np.arange(matrix.shape[1]), np.diff(sparsity.colind()))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True)]
