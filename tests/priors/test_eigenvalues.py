"""Eigenvalues that come out whatever LAPACK's iteration does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.priors import eigenvalues as eigen


def matrices() -> jax.Array:
    a = jax.random.normal(jax.random.key(0), (3, 5, 5), jnp.float64)
    return a @ jnp.swapaxes(a, 1, 2) + jnp.eye(5)[None]


def test_eigenvalues_are_those_of_numpy() -> None:
    values, vectors = jax.jit(eigen.eigh)(matrices())
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices()), rtol=1e-12)
    rebuilt = jnp.einsum("sik,sk,sjk->sij", vectors, values, vectors)
    np.testing.assert_allclose(rebuilt, matrices(), rtol=1e-10, atol=1e-12)


def test_a_matrix_on_which_the_iteration_fails_is_taken_in_another_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of the stack, as found in practice: LAPACK leaves what is not a number, and only for these digits."""
    bad, whole = matrices()[1], jnp.linalg.eigh

    def failing(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
        values, vectors = whole(matrix)
        lost = jnp.all(matrix == bad[None], axis=(1, 2))
        return jnp.where(lost[:, None], jnp.nan, values), jnp.where(lost[:, None, None], jnp.nan, vectors)

    monkeypatch.setattr(jnp.linalg, "eigh", failing)
    for run in (eigen.eigh, jax.jit(eigen.eigh)):
        values, vectors = run(matrices())
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices()), rtol=1e-12)
        assert bool(jnp.isfinite(vectors).all())
