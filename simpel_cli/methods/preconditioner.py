"""Newton's direction in function space, with the data spread evenly over the measurement set.

    P = (w C^-1 + I/c)^-1 = c C/w (C/w + c I)^-1,    c = sigma^2 k / m

C is the prior's covariance of an output at k measurement points, w the prior's exponent, 1 for Bayes, and m measurements of
noise sigma tell as much as k with sigma^2 k/m. The curvature of the log posterior spans the ratio of the prior's largest
eigenvalue to its smallest, 1e5 for a simulator and a smooth gap, and a particle that climbs it alone needs tens of thousands
of steps; times P it is about 1 in every direction. A constant P leaves the stationary law of a flow as it is; here it varies
with the points of a step, as does the score, so that many data in small batches are better off without it.

Reference: Amari (1998), Natural gradient works efficiently in learning; Wang, Tang, Bajaj and Liu (2019), Stein variational
gradient descent with matrix-valued kernels, section 3.2.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.scores.gaussian import moments


def preconditioned(
    velocity: Float[Array, "L k dy"],
    samples: Float[Array, "k dy N"],
    covariance: Float[Array, "dy k k"],
    evenly: Float[Array, " dy"],
    weight: float = 1.0,
) -> Float[Array, "L k dy"]:
    """Return P times a velocity of function values, per output.

    Args:
        velocity: of L particles.
        samples: draws of the simulator at the measurement set.
        covariance: of the Gaussian part of the prior.
        evenly: c, variance of the data as if there were one at every point.
        weight: w, positive.
    """

    def of_output(
        v: Float[Array, "L k"], s: Float[Array, "k N"], known: Float[Array, "k k"], c: Float[Array, ""]
    ) -> Float[Array, "L k"]:
        prior = (moments(s.T)[1] + known.astype(jnp.float64)) / weight
        c = c.astype(jnp.float64)
        factor = jnp.linalg.cholesky(prior + c * jnp.eye(prior.shape[0]))
        solved = jax.scipy.linalg.cho_solve((factor, True), v.T.astype(jnp.float64))
        return (c * (prior @ solved)).T.astype(v.dtype)

    return jax.vmap(of_output, in_axes=(2, 1, 0, 0), out_axes=2)(velocity, samples, covariance, evenly)
