"""Stationary kernels, and the exact Gaussian-process posterior that approximate inference is held to.

    k(x, x') = rho(|x - x'| / l),  rho(0) = 1

Reference: Rasmussen and Williams (2006), eqs. 4.9, 4.17, 2.25-2.26.
"""

from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


@runtime_checkable
class Kernel(Protocol):
    """Correlation as a function of the scaled squared distance."""

    def correlation(self, squared_distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return rho at squared distances in units of the lengthscale."""
        ...


@runtime_checkable
class Spectral(Kernel, Protocol):
    """A kernel whose sample paths can be drawn."""

    def frequencies(self, key: PRNGKeyArray, count: int, dim: int) -> Float[Array, "count dim"]:
        """Draw angular frequencies from the spectral density, per lengthscale."""
        ...


@dataclass(frozen=True)
class SquaredExponential:
    """Infinitely smooth: rho(r) = exp(-r^2 / 2)."""

    def correlation(self, squared_distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return rho at squared distances in units of the lengthscale."""
        return jnp.exp(-0.5 * squared_distance)

    def frequencies(self, key: PRNGKeyArray, count: int, dim: int) -> Float[Array, "count dim"]:
        """Draw from the spectral density, normal; Rasmussen and Williams (2006), section 4.2.1."""
        return jax.random.normal(key, (count, dim), jnp.float64)


@dataclass(frozen=True)
class Matern32:
    """Once differentiable: rho(r) = (1 + sqrt3 r) exp(-sqrt3 r)."""

    def correlation(self, squared_distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return rho at squared distances in units of the lengthscale."""
        r = _root(3.0 * squared_distance)
        return (1.0 + r) * jnp.exp(-r)

    def frequencies(self, key: PRNGKeyArray, count: int, dim: int) -> Float[Array, "count dim"]:
        """Draw from the spectral density, Student's t with 3 degrees of freedom."""
        return _student(key, count, dim, 3.0)


@dataclass(frozen=True)
class Matern52:
    """Twice differentiable: rho(r) = (1 + sqrt5 r + 5/3 r^2) exp(-sqrt5 r)."""

    def correlation(self, squared_distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return rho at squared distances in units of the lengthscale."""
        r = _root(5.0 * squared_distance)
        return (1.0 + r + r * r / 3.0) * jnp.exp(-r)

    def frequencies(self, key: PRNGKeyArray, count: int, dim: int) -> Float[Array, "count dim"]:
        """Draw from the spectral density, Student's t with 5 degrees of freedom."""
        return _student(key, count, dim, 5.0)


def _student(key: PRNGKeyArray, count: int, dim: int, freedom: float) -> Float[Array, "count dim"]:
    """Draw from the multivariate t: the spectral density of a Matern kernel; Rasmussen and Williams (2006), eq. 4.15."""
    key_normal, key_gamma = jax.random.split(key)
    normal = jax.random.normal(key_normal, (count, dim), jnp.float64)
    return normal * jnp.sqrt(freedom / 2 / jax.random.gamma(key_gamma, freedom / 2, (count, 1), jnp.float64))


def _root(squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Square root whose gradient at zero is zero, not NaN."""
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def squared_distances(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Return |a_i - b_j|^2; summed from differences, so that it cannot go negative."""
    return jnp.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)


def gram(kernel: Kernel, a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Return the correlation matrix of inputs that are already divided by the lengthscale."""
    return kernel.correlation(squared_distances(a, b))


@partial(jax.jit, static_argnums=0)
def grams(
    kernel: Kernel, a: Float[Array, "n d"], b: Float[Array, "m d"], relevance: Float[Array, "p d"]
) -> Float[Array, "p n m"]:
    """Return the correlation matrices of inputs under each of several vectors of relevances, one over the lengthscales.

    Compiled, the differences of all inputs are never in memory.
    """
    return jax.vmap(lambda own: gram(kernel, a * own[None], b * own[None]))(relevance)


def posterior(
    prior_train: Float[Array, "m m"],
    cross: Float[Array, "n m"],
    prior_test: Float[Array, "n n"],
    residual: Float[Array, " m"],
    noise_variance: Float[Array, ""] | float,
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Exact posterior of a Gaussian process with Gaussian noise.

    Args:
        prior_train: prior covariance of the m training values.
        cross: prior covariance between n test and m training values.
        prior_test: prior covariance of the n test values.
        residual: training targets less the prior mean.
        noise_variance: variance of the observation noise.

    Returns:
        Mean (n,), to which the prior mean at the test inputs is to be added, and covariance (n, n).
    """
    m = residual.shape[0]
    factor = jnp.linalg.cholesky(prior_train + noise_variance * jnp.eye(m, dtype=prior_train.dtype))
    half = jax.scipy.linalg.solve_triangular(factor, cross.T, lower=True)
    white = jax.scipy.linalg.solve_triangular(factor, residual[:, None], lower=True)
    return (half.T @ white)[:, 0], prior_test - half.T @ half
