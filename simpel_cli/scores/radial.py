"""Radial kernels of the estimators that work on draws: profile over the squared distance, and the width of it.

k(x, y) = f(|x - y|^2 / s^2)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError
from simpel_cli.priors.eigenvalues import eigh

KERNELS = ("squared_exponential", "imq")
LOOKED_AT = 128  # draws of which the median distance is taken


class Profile(NamedTuple):
    """A kernel's profile f at squared distances, and its first three derivatives."""

    f: Float[Array, "*n"]
    f1: Float[Array, "*n"]
    f2: Float[Array, "*n"]
    f3: Float[Array, "*n"]


def profile(kernel: str, q: Float[Array, "*n"]) -> Profile:
    """Return f and its derivatives at squared distances q in units of the width.

    squared_exponential: exp(-q/2);  imq, the inverse multiquadric: (1 + q)^(-1/2), whose tails reach draws far away.
    """
    if kernel == "squared_exponential":
        f = jnp.exp(-q / 2)
        return Profile(f, -f / 2, f / 4, -f / 8)
    r = 1 / (1 + q)
    f = jnp.sqrt(r)
    return Profile(f, -f * r / 2, 3 / 4 * f * r**2, -15 / 8 * f * r**3)


def squared_distances(a: Float[Array, "A M"], b: Float[Array, "B M"]) -> Float[Array, "A B"]:
    """Squared Euclidean distances, never negative."""
    products = jnp.sum(a**2, axis=1)[:, None] + jnp.sum(b**2, axis=1)[None] - 2 * a @ b.T
    return jnp.maximum(products, 0.0)


def width(bandwidth: float | str, wider: float, x: Float[Array, "N M"]) -> Float[Array, ""]:
    """Return s: a number as it is given, or so many times the median distance between draws."""
    if not isinstance(bandwidth, str):
        return jnp.asarray(bandwidth, x.dtype)
    few = x[:LOOKED_AT]
    n = few.shape[0]
    apart = squared_distances(few, few)[jnp.triu_indices(n, 1)]
    return wider * jnp.sqrt(jnp.median(apart)) + jnp.finfo(x.dtype).tiny ** 0.5


def check(kernel: str, bandwidth: float | str, baseline: str) -> None:
    """Refuse what no estimator knows.

    Raises:
        ConfigError: with what is allowed.
    """
    if kernel not in KERNELS:
        raise ConfigError(f"score.kernel: got {kernel!r}; allowed are {' and '.join(KERNELS)}.")
    if (isinstance(bandwidth, str) and bandwidth != "median") or (not isinstance(bandwidth, str) and not bandwidth > 0):
        raise ConfigError(f"score.bandwidth: got {bandwidth!r}; allowed are median and a positive number.")
    if baseline not in ("gaussian", "none"):
        raise ConfigError(f"score.baseline: got {baseline!r}; allowed are gaussian and none.")


def subspace(matrix: Float[Array, "P P"], rank: int, key: Array, passes: int = 2) -> tuple[Array, Array]:
    """Return the largest eigenvalues of a positive semidefinite matrix, falling, (J,), and their eigenvectors, (P, J).

    Reference: Halko, Martinsson and Tropp (2011), Finding structure with randomness, algorithms 4.4 and 5.3.
    """
    start = jax.random.normal(key, (matrix.shape[0], rank), matrix.dtype)
    basis = jnp.linalg.qr(matrix @ start)[0]
    for _ in range(passes):
        basis = jnp.linalg.qr(matrix @ basis)[0]
    values, vectors = eigh(basis.T @ matrix @ basis)
    return values[::-1], (basis @ vectors)[:, ::-1]
