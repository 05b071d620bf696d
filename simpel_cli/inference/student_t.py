"""Student's t as a law of measurement noise, by the tail tau = 1/nu: 0 is the Gaussian, 1/2 has no variance.

    p(e) = Gamma((nu + 1)/2) / (Gamma(nu/2) sqrt(pi nu) sigma) (1 + z^2/nu)^(-(nu + 1)/2),    z = e/sigma

sigma is the scale; the standard deviation is sigma/sqrt(1 - 2 tau). A Gaussian of variance sigma^2/w, w ~ Gamma(nu/2, nu/2), is
the same law, so that a row that is far off counts as one of less weight,

    E[w | e] = (nu + 1)/(nu + z^2).

Reference: Lange, Little and Taylor (1989), Robust statistical modeling using the t distribution, JASA 84, eq. 5 (weights),
sec. 3 (information); Gneiting and Raftery (2007) for the CRPS as a difference of expectations.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

MOST_TAIL = 0.45  # a little below 1/2, where the variance ends
QUANTILES = 600  # entries of the table of quantiles, on either side
NODES, FARTHEST = 96, 60.0  # of the table of expected distances; of its last entry, in scales


def log_density(z: Float[Array, "*n"], tail: Float[Array, "*m"]) -> Float[Array, "*n"]:
    """Return the log density of a standardised error, without the logarithm of the scale; tail broadcasts."""
    nu = 1 / tail
    constant = jax.lax.lgamma((nu + 1) / 2) - jax.lax.lgamma(nu / 2) - 0.5 * jnp.log(jnp.pi * nu)
    return constant - (nu + 1) / 2 * jnp.log1p(z * z * tail)


def weight(squared: Float[Array, "*n"], tail: Float[Array, "*m"]) -> Float[Array, "*n"]:
    """Return the expected weight of a row whose standardised error has this expected square."""
    return (1 + tail) / (1 + tail * squared)


def information(tail: Float[Array, "*d"]) -> tuple[Float[Array, "*d"], Float[Array, "*d"]]:
    """Return the Fisher information of the location, over that of a Gaussian of the same scale, and of the log scale.

    (nu + 1)/(nu + 3) and 2 nu/(nu + 3) (Lange et al. 1989, sec. 3).
    """
    return (1 + tail) / (1 + 3 * tail), 2 / (1 + 3 * tail)


def standard_deviation(scale: Float[Array, "*n"], tail: Float[Array, "*m"] | None) -> Float[Array, "*n"]:
    """Return the standard deviation of a scale; tail None: of a Gaussian they are the same."""
    return scale if tail is None else scale / jnp.sqrt(1 - 2 * tail)


def cdf(z: Float[Array, "*n"], tail: Float[Array, "*m"]) -> Float[Array, "*n"]:
    """Return the cumulative distribution of a standardised error; tail broadcasts."""
    nu = jnp.broadcast_to(1 / tail, z.shape)
    below = 0.5 * jax.scipy.special.betainc(nu / 2, jnp.full_like(z, 0.5), nu / (nu + z * z))
    return jnp.where(z > 0, 1 - below, below)


def quantile(level: Float[Array, "*n"], tail: Float[Array, ""]) -> Float[Array, "*n"]:
    """Return the standardised error below which lies a share of the mass, by a table, to 1e-3 of it."""
    half = jnp.sinh(jnp.linspace(0.0, 9.0, QUANTILES, dtype=level.dtype))
    grid = jnp.concatenate([-half[:0:-1], half])
    return jnp.interp(level, cdf(grid, jnp.broadcast_to(tail, grid.shape)), grid)


def expected_distance(mu: Float[Array, "*n"], tail: Float[Array, "*m"]) -> Float[Array, "*n"]:
    """Return E|mu + T|, T standard: mu (2 F(mu) - 1) + 2 f(mu) (nu + mu^2)/(nu - 1)."""
    density = jnp.exp(log_density(mu, tail))
    return mu * (2 * cdf(mu, tail) - 1) + 2 * density * (1 + tail * mu * mu) / (1 - tail)


def distance_table(tail: Float[Array, " d"]) -> tuple[Float[Array, " G"], Float[Array, "d G"]]:
    """Return a grid of distances between two centres, and E|delta + T - T'| there, T and T' standard and independent.

    The second expectation is a Gauss-Legendre sum over the angle of T' = sqrt(nu) tan(angle), whose density goes with
    cos^(nu - 1). Beyond the grid the distance itself is the answer, to 1e-3 of it.
    """
    delta = jnp.asarray(np.concatenate([[0.0], np.geomspace(0.02, FARTHEST, NODES - 1)]), tail.dtype)
    node, share = (jnp.asarray(a, tail.dtype) for a in np.polynomial.legendre.leggauss(NODES))

    def of_output(tail: Float[Array, ""]) -> Float[Array, " G"]:
        # nodes where the mass is: sqrt(nu) tan(angle) has a width of about one
        reach = jnp.arctan(jnp.sqrt(tail) * 400.0)
        angle = reach * node
        mass = share * jnp.exp((1 / tail - 1) * jnp.log(jnp.cos(angle)))
        other = jnp.tan(angle) / jnp.sqrt(tail)
        far = expected_distance(delta[:, None] - other[None], jnp.broadcast_to(tail, (NODES, NODES)))
        return jnp.sum(far * mass[None], axis=1) / jnp.sum(mass)

    return delta, jax.vmap(of_output)(tail)
