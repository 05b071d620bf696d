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


def preconditioned(
    velocity: Float[Array, "L k dy"],
    covariance: Float[Array, "dy k k"],
    evenly: Float[Array, " dy"],
    weight: float = 1.0,
) -> Float[Array, "L k dy"]:
    """Return P times a velocity of function values, per output.

    Args:
        velocity: of L particles.
        covariance: C of every output, float64.
        evenly: c, variance of the data as if there were one at every point.
        weight: w, positive.
    """

    def of_output(v: Float[Array, "L k"], prior: Float[Array, "k k"], c: Float[Array, ""]) -> Float[Array, "L k"]:
        prior, c = prior / weight, c.astype(prior.dtype)
        factor = jnp.linalg.cholesky(prior + c * jnp.eye(prior.shape[0]))
        solved = jax.scipy.linalg.cho_solve((factor, True), v.T.astype(prior.dtype))
        return (c * (prior @ solved)).T.astype(v.dtype)

    return jax.vmap(of_output, in_axes=(2, 0, 0), out_axes=2)(velocity, covariance, evenly)
