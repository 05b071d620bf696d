"""Small matrices at many points at once: trailing axes are windows and hypotheses."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from simpel_cli.runs.settings import current_device


def product(a: Float[Array, "n k ..."], b: Float[Array, "k m ..."]) -> Float[Array, "n m ..."]:
    """Product of small matrices at every point: sums that XLA fuses, where it would call a matrix routine per point."""
    return sum((a[:, j, None] * b[None, j] for j in range(1, a.shape[1])), a[:, 0, None] * b[None, 0])


def sure_of(level: Float[Array, "..."]) -> Bool[Array, ""]:
    """Return True, which no compiler can know, from something that is never -1, such as a level of noise."""
    return level[(0,) * level.ndim] != -1


def applied(a: Float[Array, "n k ..."], x: Float[Array, "k ..."]) -> Float[Array, "n ..."]:
    """Matrix times vector at every point."""
    return product(a, x[:, None])[:, 0]


def apart(sure: Bool[Array, ""], work: Callable[..., Any], *values: Any) -> Any:
    """Work something out once.

    Left to itself XLA works a small product out anew in every place that uses it, up to fifteen times; on a CPU its barriers
    are gone before that is decided. A branch is worked out for itself. On a GPU a branch would wait for the host.
    """
    if current_device().platform != "cpu":
        return jax.lax.optimization_barrier(work(*values))
    return where_asked(sure, work, *values)


def where_asked(asked: Bool[Array, ""], work: Callable[..., Any], *values: Any) -> Any:
    """Zeros where something is not asked for, which is not worked out then."""
    shapes = jax.eval_shape(work, *values)
    return jax.lax.cond(asked, work, lambda *_: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes), *values)


def along(a: Array, extra: int) -> Array:
    """Append axes of length one, so that an array is the same at all points."""
    return a.reshape(*a.shape, *(1,) * extra)
