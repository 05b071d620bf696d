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
from jaxtyping import Array, Float, PRNGKeyArray

MOST_TAIL = 0.45  # a little below 1/2, where the variance ends
QUANTILES = 600  # entries of the table of quantiles, on either side
CELLS, LAST = 1024, 12.0  # of the table of the distribution in asinh(z)
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


def cdf_of_outputs(z: Float[Array, "*n d"], tail: Float[Array, " d"]) -> Float[Array, "*n d"]:
    """Return the same for many errors of each output, to 1e-8: cubic Hermite interpolation, the density being the slope."""
    at = jnp.linspace(-LAST, LAST, CELLS + 1, dtype=z.dtype)
    width = 2 * LAST / CELLS
    node = jnp.broadcast_to(jnp.sinh(at)[:, None], (CELLS + 1, len(tail)))
    value = cdf(node, tail[None])
    slope = jnp.exp(log_density(node, tail[None])) * jnp.cosh(at)[:, None] * width
    place = (jnp.clip(jnp.arcsinh(z), -LAST, LAST) + LAST).reshape(-1, len(tail)) / width
    cell = jnp.minimum(place.astype(jnp.int32), CELLS - 1)
    (f, df), (g, dg) = ([jnp.take_along_axis(a, cell + k, axis=0) for a in (value, slope)] for k in (0, 1))
    w = place - cell.astype(place.dtype)
    found: Array = f + w * (df + w * (3 * (g - f) - 2 * df - dg + w * (df + dg - 2 * (g - f))))
    return jnp.clip(found, 0.0, 1.0).reshape(z.shape)


def quantile(level: Float[Array, "*n"], tail: Float[Array, ""]) -> Float[Array, "*n"]:
    """Return the standardised error below which lies a share of the mass, by a table, to 1e-3 of it."""
    half = jnp.sinh(jnp.linspace(0.0, 9.0, QUANTILES, dtype=level.dtype))
    grid = jnp.concatenate([-half[:0:-1], half])
    return jnp.interp(level, cdf(grid, jnp.broadcast_to(tail, grid.shape)), grid)


def draws(key: PRNGKeyArray, shape: tuple[int, ...], tail: Float[Array, " d"]) -> Float[Array, "*n d"]:
    """Return standardised errors by the table of quantiles; gamma variates by rejection take ten times as long."""
    level = jax.random.uniform(key, (len(tail), *shape), tail.dtype, 1e-6, 1 - 1e-6)
    return jnp.moveaxis(jax.vmap(quantile)(level, tail), 0, -1)


def expected_distance(mu: Float[Array, "*n d"], tail: Float[Array, " d"]) -> Float[Array, "*n d"]:
    """Return E|mu + T|, T standard, of every output: mu (2 F(mu) - 1) + 2 f(mu) (nu + mu^2)/(nu - 1)."""
    each = tail.reshape((1,) * (mu.ndim - 1) + tail.shape)
    density = jnp.exp(log_density(mu, each))
    return mu * (2 * cdf_of_outputs(mu, tail) - 1) + 2 * density * (1 + each * mu * mu) / (1 - each)


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
        far = expected_distance((delta[:, None] - other[None])[:, :, None], tail[None])[:, :, 0]
        return jnp.sum(far * mass[None], axis=1) / jnp.sum(mass)

    return delta, jax.vmap(of_output)(tail)
