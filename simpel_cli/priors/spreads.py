"""The spread of groups about their population, chosen by the evidence: what follows from where the groups came to rest.

    c_g = c + s delta_g,    delta_g ~ N(0, 1):    s^2 <- s^2 sum_g delta_g^2 / gamma,    gamma = sum_g (1 - var delta_g)

s and delta_g have no common optimum: the joint posterior grows as s rises and the delta_g shrink, s delta_g as it is, since
their prior is all that changes. So a fit holds s and goes on with another. Of the Laplace approximation to the evidence of s,
-1/2 sum delta^2 - 1/2 log |H|, the derivative by log s is sum delta^2 - gamma, with the variances in H^-1 (of all unknowns, so
that what was spent on the common value counts): the update rests where the evidence does. gamma counts the groups that the
data know. Where they hardly know one, the step of expectation and maximisation, s^2 <- s^2 mean E[delta^2], is the stable one.

Reference: MacKay (1992), Bayesian interpolation, eq. 32; Gelman and Hill (2007), ch. 12; Harville (1977), Maximum likelihood
approaches to variance component estimation (for a linear model this is REML).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

LEAST = 0.01  # of the range of a spread, above its lower end: groups are alike


def factor_of(squares: Float[Array, "*K"], gamma: Float[Array, "*K"], size: int) -> Float[Array, "*K"]:
    """Return by what a spread is to be multiplied.

    Args:
        squares: sum of squares of what the groups are, in standard deviations of the population.
        gamma: number of groups that the data know.
        size: number of groups.
    """
    return jnp.sqrt(jnp.where(gamma > 1, squares / gamma, (squares + size - gamma) / size))


def sd_of_log(gamma: Float[Array, "*K"]) -> Float[Array, "*K"]:
    """Return the standard deviation of the logarithm of a spread; gamma: number of groups that the data know."""
    return 1 / jnp.sqrt(2 * jnp.maximum(gamma, 0.5))
