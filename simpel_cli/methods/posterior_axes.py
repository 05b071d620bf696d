"""Axes of the posterior of function values, in which a rule works on all outputs alike, whatever their scales.

    P = (w C^-1 + I/c)^-1 = V diag(p) V',    p = c l/(l + w c),    C = V diag(l) V',    c = sigma^2 k / m

C is the prior's covariance of an output at k measurement points, w the prior's exponent, 1 for Bayes, and m measurements of
noise sigma tell as much as k with sigma^2 k/m. The curvature of the log posterior spans the ratio of the prior's largest
eigenvalue to its smallest, 1e5 for a simulator and a smooth gap, and a particle that climbs it alone needs tens of thousands
of steps; times P it is about 1 in every direction. A kernel that measures distances in units of P's standard deviations suits
every output and every point.

Reference: Amari (1998), Natural gradient works efficiently in learning; Wang, Tang, Bajaj and Liu (2019), Stein variational
gradient descent with matrix-valued kernels, section 3.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.priors.eigenvalues import eigh

LEAST = 0.01  # of the largest eigenvalue of P: what is narrower tells no particles apart

Moved = tuple[Float[Array, "L k dy"], Float[Array, ""]]
Velocity = Callable[[Float[Array, "L k"], Float[Array, "L k"]], tuple[Float[Array, "L k"], Float[Array, ""]]]


class Basis(NamedTuple):
    """Eigenvalues and eigenvectors of the prior's covariance of every output: taken once for a set of points."""

    values: Float[Array, "*S dy k"]
    vectors: Float[Array, "*S dy k k"]


def basis(covariance: Float[Array, "dy k k"], dtype: jnp.dtype) -> Basis:
    """Return the eigenbasis of covariances, taken in float64; no direction is amplified, so that `dtype` may be less."""
    values, vectors = eigh(covariance.astype(jnp.float64))
    return Basis(jnp.maximum(values, 0.0).astype(dtype), vectors.astype(dtype))


class Axes(NamedTuple):
    """Axes of the posterior of every output at k points, and how far it reaches along each.

    Args:
        vectors: orthonormal, in columns.
        share: eigenvalues of P.
        scale: root of k times the eigenvalues of P, those held at `LEAST` of the largest that are less: in these units a draw
            of the posterior has a norm of about 1, and directions that are hardly free do not tell particles apart.
    """

    vectors: Float[Array, "dy k k"]
    share: Float[Array, "dy k"]
    scale: Float[Array, "dy k"]

    def moved(self, velocity: Velocity, h: Float[Array, "L k dy"], score: Float[Array, "L k dy"]) -> Moved:
        """Return where a rule under the kernel P K moves function values, each output by itself.

        Args:
            velocity: of the rule: points (L, k) and scores there -> velocities, and how near the points are.
            h: function values.
            score: of their log density.
        """
        turned = jnp.einsum("dkj,lkd->dlj", self.vectors, h) / self.scale[:, None]
        drive = jnp.einsum("dkj,lkd->dlj", self.vectors, score) * self.scale[:, None]
        found, near = jax.vmap(velocity)(turned, drive)
        back = found * (self.share / self.scale)[:, None]
        return jnp.einsum("dkj,dlj->lkd", self.vectors, back), jnp.mean(near)


def axes_of(prior: Basis, evenly: Float[Array, " dy"], weight: float = 1.0) -> Axes:
    """Return the axes of P.

    Args:
        prior: of C.
        evenly: c, variance of the data as if there were one at every point.
        weight: w, positive.
    """
    share = evenly[:, None] * prior.values / (prior.values + weight * evenly[:, None])
    most = jnp.max(share, axis=1, keepdims=True)
    held = jnp.where(most > 0, jnp.maximum(share, LEAST * most), 1.0)  # what the prior knows already does not move
    return Axes(prior.vectors, share, jnp.sqrt(held * share.shape[1]))
