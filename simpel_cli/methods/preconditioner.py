"""Newton's direction in function space, with the data spread evenly over the measurement set.

    P = (w C^-1 + I/c)^-1 = V diag(c l/(l + w c)) V',    C = V diag(l) V',    c = sigma^2 k / m

C is the prior's covariance of an output at k measurement points, w the prior's exponent, 1 for Bayes, and m measurements of
noise sigma tell as much as k with sigma^2 k/m. The curvature of the log posterior spans the ratio of the prior's largest
eigenvalue to its smallest, 1e5 for a simulator and a smooth gap, and a particle that climbs it alone needs tens of thousands
of steps; times P it is about 1 in every direction. A constant P leaves the stationary law of a flow as it is; here it varies
with the points of a step, as does the score, so that many data in small batches are better off without it.

Reference: Amari (1998), Natural gradient works efficiently in learning; Wang, Tang, Bajaj and Liu (2019), Stein variational
gradient descent with matrix-valued kernels, section 3.2.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.priors.eigenvalues import eigh


class Basis(NamedTuple):
    """Eigenvalues and eigenvectors of the prior's covariance of every output: taken once for a set of points."""

    values: Float[Array, "*S dy k"]
    vectors: Float[Array, "*S dy k k"]


def basis(covariance: Float[Array, "dy k k"], dtype: jnp.dtype) -> Basis:
    """Return the eigenbasis of covariances, taken in float64; no direction is amplified, so that `dtype` may be less."""
    values, vectors = eigh(covariance.astype(jnp.float64))
    return Basis(jnp.maximum(values, 0.0).astype(dtype), vectors.astype(dtype))


def preconditioned(
    velocity: Float[Array, "L k dy"], prior: Basis, evenly: Float[Array, " dy"], weight: float = 1.0
) -> Float[Array, "L k dy"]:
    """Return P times a velocity of function values, per output.

    Args:
        velocity: of L particles.
        prior: of C.
        evenly: c, variance of the data as if there were one at every point.
        weight: w, positive.
    """
    share = evenly[:, None] * prior.values / (prior.values + weight * evenly[:, None])
    turned = jnp.einsum("dkj,lkd->dlj", prior.vectors, velocity) * share[:, None]
    return jnp.einsum("dkj,dlj->lkd", prior.vectors, turned)
