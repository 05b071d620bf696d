"""Eigenvalues of symmetric matrices that come out whatever LAPACK's iteration does."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

OTHER_UNIT = 1.7  # any number that changes the digits


def eigh(matrix: Float[Array, "*S k k"]) -> tuple[Float[Array, "*S k"], Float[Array, "*S k k"]]:
    """Return eigenvalues, rising, and eigenvectors, as columns.

    About one in a hundred thousand well-conditioned matrices is none that LAPACK's divide and conquer converges on; what comes
    back is not a number, and a training of an hour ends. In another unit the same matrix has other digits, and it converges.
    """
    found = jnp.linalg.eigh(matrix)

    def again() -> tuple[Array, Array]:
        values, vectors = jnp.linalg.eigh(OTHER_UNIT * matrix)
        return values / OTHER_UNIT, vectors

    values, vectors = jax.lax.cond(jnp.isfinite(found[0]).all(), lambda: tuple(found), again)
    return values, vectors
