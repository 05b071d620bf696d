"""What a predictive says of a sensor that saturates: its reading is min(max(y, low), high).

At an end the reading has the mass of the law there or beyond, between the ends the law's density.

The probability integral transform of a mass is anything between F(y-) and F(y): it counts by the share of these that lies in a
region, the expectation of a transform drawn at random. So a right predictive is covered as it says, exactly.

Reference: Gneiting and Raftery (2007), Strictly proper scoring rules, JASA 102 (scores of mixed laws; the CRPS as a difference
of expectations); Smith (1985), Diagnostic checks of non-standard time series models, J. Forecasting 4, and Czado, Gneiting and
Held (2009), Predictive model assessment for count data, Biometrics 65 (the transform of a mass).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from simpel_cli.inference import student_t

MOST_CELLS, FEWEST_CELLS, MOST_ATOMS = 128, 32, 4096
HIDDEN = 32  # values per particle that a reading at an end may hide
STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0]) % 1  # of a lattice, one per output
WIDEST, HALVINGS = 100.0, 60  # scales within which quantiles of Student's t are looked for


def ends(limits: Float[Array, "dy 2"], y: Float[Array, "n dy"]) -> tuple[Bool[Array, "n dy"], Bool[Array, "n dy"]]:
    """Return which readings lie at the low and at the high end."""
    return y <= limits[None, :, 0].astype(y.dtype), y >= limits[None, :, 1].astype(y.dtype)


def log_cdf(z: Float[Array, "*n"], tail: Float[Array, "*m"] | None) -> Float[Array, "*n"]:
    """Return the log of the mass below a standardised value; tail broadcasts."""
    if tail is None:
        return jax.scipy.special.log_ndtr(z)
    return jnp.log(jnp.maximum(student_t.cdf(z, tail), jnp.finfo(z.dtype).tiny))


def share(low: np.ndarray, high: np.ndarray, between: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the share of the transforms from low to high, (n,), that lies between two levels, each (k,); shape (n, k)."""
    low, high = low[:, None], high[:, None]
    inside = (low >= between[0]) & (low <= between[1])
    covered = np.minimum(high, between[1]) - np.maximum(low, between[0])
    apart = high > low
    found: np.ndarray = np.where(apart, np.maximum(covered, 0) / np.where(apart, high - low, 1.0), inside)
    return found


def hidden(
    particles: Float[Array, "L n dy"],
    scale: Float[Array, "n dy"],
    tail: Float[Array, " dy"] | None,
    limits: Float[Array, "dy 2"],
    y: Float[Array, "n dy"],
) -> Float[Array, "L K n dy"]:
    """Return values that may lie behind readings, in K equal shares of every particle's mass at or beyond an end.

    Shares of several outputs go through a lattice, since they are independent under a particle. Readings between the ends are
    what they are. Arguments are those of `crps`.
    """
    at_low, at_high = ends(limits, y)
    side = jnp.where(at_high, 1.0, -1.0).astype(y.dtype)[None]
    nodes = (np.arange(HIDDEN)[:, None] * STEPS[None] + 0.5 / HIDDEN) % 1
    nodes[:, 0] = (np.arange(HIDDEN) + 0.5) / HIDDEN
    outputs = np.arange(y.shape[1]) % nodes.shape[1]
    level = jnp.asarray(nodes[:, outputs], y.dtype)[None, :, None]
    beyond = jnp.exp(log_cdf(side * (particles - y[None]) / scale[None], None if tail is None else tail[None, None]))
    least = jnp.maximum(beyond[:, None] * level, jnp.finfo(y.dtype).tiny)
    if tail is None:
        z = jax.scipy.special.ndtri(least)
    else:
        z = jnp.moveaxis(jax.lax.map(lambda given: student_t.quantile(*given), (jnp.moveaxis(least, 3, 0), tail)), 0, 3)
    value = particles[:, None] - side[None] * scale[None, None] * z
    return jnp.where((at_low | at_high)[None, None], value, y[None, None])


def crps(
    particles: Float[Array, "L n dy"],
    scale: Float[Array, "n dy"],
    tail: Float[Array, " dy"] | None,
    limits: Float[Array, "dy 2"],
    y: Float[Array, "n dy"],
) -> Float[Array, "n dy"]:
    """Return the CRPS of readings Y, E|Y - y| - E|Y - Y'|/2; y lies between the ends.

    The first term is in closed form. For the second the law of every particle is cut into K cells of equal mass, and each is
    replaced by its mean as the sensor reads it: what lies apart within a cell is missing, 3e-4 of the scale.

    Args:
        particles: centres, data units.
        scale: of the noise.
        tail: 1/nu of Student's t; None: Gaussian.
        limits: low and high end of every output.
        y: readings.
    """
    cells = max(FEWEST_CELLS, min(MOST_CELLS, MOST_ATOMS // particles.shape[0]))
    mass = jnp.arange(1, cells, dtype=y.dtype) / cells
    tails = jnp.zeros(y.shape[1], y.dtype) if tail is None else tail

    def of_output(given: tuple[Array, ...]) -> Float[Array, " n"]:
        centre, scale, own, (low, high), y = given
        nu = None if tail is None else own
        edges = jax.scipy.special.ndtri(mass) if nu is None else _quantiles(mass, nu)
        known = jnp.isfinite(low), jnp.isfinite(high)
        # an end that there is not is never reached: any number does
        z = [
            jnp.where(is_end, (end - centre) / scale[None], 0.0) for is_end, end in zip(known, (low, high), strict=True)
        ]
        under = [_shortfall(each, nu) * scale[None] for each in (*z, (y[None] - centre) / scale[None])]
        above = jnp.where(known[1], high - y[None] - under[1], centre - y[None])
        apart = jnp.mean(2 * under[2] - jnp.where(known[0], under[0], 0.0) + above, axis=0)

        # cells (K, L, n): mass and first moment up to their edges, as far as they lie between the ends
        below = (
            jnp.where(known[0], jnp.exp(log_cdf(z[0], nu)), 0.0),
            jnp.where(known[1], jnp.exp(log_cdf(z[1], nu)), 1.0),
        )
        up_to = [jnp.where(is_end, _partial(each, nu), 0.0) for is_end, each in zip(known, z, strict=True)]
        ends = jnp.zeros(1, y.dtype), jnp.ones(1, y.dtype)
        levels = jnp.concatenate([ends[0], mass, ends[1]])[:, None, None]
        moments = jnp.concatenate([ends[0], _partial(edges, nu), ends[0]])[:, None, None]
        at = jnp.where(
            levels <= below[0][None], up_to[0][None], jnp.where(levels >= below[1][None], up_to[1][None], moments)
        )
        at_low = jnp.diff(jnp.minimum(levels, below[0][None]), axis=0) * z[0][None]
        at_high = jnp.diff(jnp.maximum(levels, below[1][None]), axis=0) * z[1][None]
        means = cells * (jnp.diff(at, axis=0) + at_low + at_high) * scale[None, None] + (centre - y[None])[None]
        atoms = jnp.sort(means.reshape(-1, y.shape[0]), axis=0)
        rank = 2 * jnp.arange(atoms.shape[0], dtype=y.dtype) + 1 - atoms.shape[0]
        return apart - jnp.mean(rank[:, None] * atoms, axis=0) / atoms.shape[0]

    columns = (jnp.moveaxis(particles, 2, 0), scale.T, tails, limits.astype(y.dtype), y.T)
    found: Array = jax.lax.map(of_output, columns)
    return found.T


def _partial(z: Float[Array, "*n"], tail: Float[Array, ""] | None) -> Float[Array, "*n"]:
    """Return E[T; T < z] of a standardised error."""
    if tail is None:
        return -jnp.exp(-0.5 * z * z) / (2 * jnp.pi) ** 0.5
    return -jnp.exp(student_t.log_density(z, tail)) * (1 + tail * z * z) / (1 - tail)


def _shortfall(z: Float[Array, "*n"], tail: Float[Array, ""] | None) -> Float[Array, "*n"]:
    """Return E max(z - T, 0) of a standardised error."""
    return z * jnp.exp(log_cdf(z, tail)) - _partial(z, tail)


def _quantiles(levels: Float[Array, " K"], tail: Float[Array, ""]) -> Float[Array, " K"]:
    """Return quantiles of Student's t by halving."""

    def halved(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        below = student_t.cdf(middle, tail) < levels
        return jnp.where(below, middle, ends[0]), jnp.where(below, ends[1], middle)

    low, high = jax.lax.fori_loop(0, HALVINGS, halved, (jnp.full_like(levels, -WIDEST), jnp.full_like(levels, WIDEST)))
    return (low + high) / 2
