"""Small matrices at many points at once: trailing axes are windows and hypotheses."""

from typing import Any

import jax
from jaxtyping import Array, Float


def product(a: Float[Array, "n k ..."], b: Float[Array, "k m ..."]) -> Float[Array, "n m ..."]:
    """Product of small matrices at every point: sums that XLA fuses, where it would call a matrix routine per point."""
    return sum((a[:, j, None] * b[None, j] for j in range(1, a.shape[1])), a[:, 0, None] * b[None, 0])


def apart(values: Any) -> Any:
    """Keep XLA from working values out again in every place that uses them."""
    return jax.lax.optimization_barrier(values)


def along(a: Array, extra: int) -> Array:
    """Append axes of length one, so that an array is the same at all points."""
    return a.reshape(*a.shape, *(1,) * extra)
