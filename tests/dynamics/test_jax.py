"""What the project needs of JAX itself."""

import jax
import jax.numpy as jnp
import numpy as np


def test_conjugate_gradients_are_right_however_they_are_compiled() -> None:
    """jaxlib 0.10.2 gets about half of these wrong, silently, unless `simpel_cli/__init__.py` switches its fusions off."""
    random = np.random.default_rng(0)
    n, m = 128, 40
    x = random.normal(size=(n, m)) / np.sqrt(2 * m)
    q = ((x[:, None] - x[None]) ** 2).sum(axis=-1)
    a, b = 1 / np.sqrt(1 + q) ** 3, 3 / np.sqrt(1 + q) ** 5
    given = [jnp.asarray(v) for v in (x, a, b)]
    wanted = random.normal(size=(n, m))

    def operator(x: jax.Array, a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
        along = b * (x @ c.T - jnp.sum(x * c, axis=1)[None])
        return a @ c - jnp.sum(along, axis=1)[:, None] * x + along @ x + 0.128 * c

    def solve(x: jax.Array, a: jax.Array, b: jax.Array, right: jax.Array, k: int) -> jax.Array:
        found = jax.scipy.sparse.linalg.cg(lambda c: operator(x, a, b, c), right, tol=1e-10, maxiter=500)[0]
        return found + 1e-12 * k  # reaches the program: every k is compiled anew

    right = operator(*given, jnp.asarray(wanted))
    for k in range(12):
        found = jax.jit(lambda *args, k=k: solve(*args, k))(*given, right)
        np.testing.assert_allclose(found, wanted, atol=1e-6)
