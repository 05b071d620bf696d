"""Scale of a Gaussian process and noise of the largest marginal likelihood about a known mean.

    y - mean ~ N(0, kappa^2 R + (w + sigma^2) I),    R = V diag(values) V'

In JAX, since the mean is identified there (`gap_scale.py` does the same for a simulator whose parameters are integrated out).

Reference: Rasmussen and Williams (2006), eq. 5.8.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

Numbers = Array | np.ndarray
MOST_ROWS = 512  # whose marginal likelihood is taken: time grows as their third power
NOISES = 41  # levels that are tried, from the floor to the targets' spread
LONGER = 1.0, 2.0, 4.0, 8.0, 16.0  # lengthscales that are tried, over the declared one
SCALES = 1e-3, 10.0, 41  # that are tried: first, last, how many
TYPICAL_SCALE, SPREAD_OF_SCALES = 0.1, 2.0  # log kappa ~ N(log 0.1, 2^2), which decides where few data do not


def evenly(padded: int, rows: Int[Numbers, ""], most: int) -> tuple[Int[Array, " c"], Int[Array, ""]]:
    """Return which rows to look at, no more than `most`, evenly, and how many of them are data, which come first.

    Args:
        padded: number of rows with padding.
        rows: number of data.
        most: how many to look at.
    """
    every, count = jnp.arange(min(padded, most), dtype=jnp.int32), jnp.asarray(rows)
    apart = jnp.maximum(count.astype(jnp.float64) / most, 1.0)
    return jnp.floor(every.astype(jnp.float64) * apart).astype(jnp.int32), jnp.minimum(count, most)


class Spectrum(NamedTuple):
    """Residuals in the eigenbasis of the correlation at the training inputs, float64.

    Padding has eigenvalue 0 and no residual. One basis serves all outputs (k = dy), or, with a leading axis, each has its own
    (k = 1).
    """

    values: Float[Array, "*dy m"]
    vectors: Float[Array, "*dy m m"]
    turned: Float[Array, "*dy m k"]
    padding: Float[Array, "*dy"]


class MarginalLikelihoodFit(NamedTuple):
    """Per output, normalised: kappa, sigma, and minus the logarithm of the penalised marginal likelihood."""

    scale: Float[Array, " dy"]
    noise: Float[Array, " dy"]
    loss: Float[Array, " dy"]


def spectrum(correlation: Float[Array, "m m"], residual: Float[Array, "m dy"], rows: Int[Numbers, ""]) -> Spectrum:
    """Return the spectrum.

    Args:
        correlation: at the padded inputs.
        residual: of their targets.
        rows: number of data, which come first; the others are padding.
    """
    counts = (jnp.arange(len(residual), dtype=jnp.int32) < rows).astype(jnp.float64)
    values, vectors = jnp.linalg.eigh(correlation.astype(jnp.float64) * counts[:, None] * counts[None])
    turned = vectors.T @ (residual.astype(jnp.float64) * counts[:, None])
    return Spectrum(jnp.maximum(values, 0.0), vectors, turned, counts.shape[0] - jnp.sum(counts))


def weighted_spectra(
    correlation: Float[Array, "d m m"],
    residual: Float[Array, "m dy"],
    rows: Int[Numbers, ""],
    weights: Float[Numbers, "m dy"] | None,
    tells: Float[Numbers, "m dy"] | None = None,
    kappa: Float[Array, " dy"] | None = None,
    white: float = 0.0,
) -> Spectrum:
    """Return the spectrum of rows that count by their weights, one per output, leading axis dy; None: all alike, one for all.

    Rows and columns times the roots of the weights: N(0, K + sigma^2 W^-1) becomes N(0, W^1/2 K W^1/2 + sigma^2 I). Where
    `tells` is 0 a row is left out, as padding is. With weights and `kappa` K is kappa^2 times the correlation, with `white` on
    its diagonal: what is no noise is not divided by the weights. The correlation is one that all outputs share (d = 1),
    or, with weights, each has its own (d = dy).
    """
    if weights is None:
        return spectrum(correlation[0], residual, rows)
    correlation = jnp.broadcast_to(correlation.astype(jnp.float64), (residual.shape[1], *correlation.shape[1:]))
    root = jnp.sqrt(jnp.asarray(weights).astype(jnp.float64)).T
    if tells is not None:
        root = root * jnp.asarray(tells).astype(jnp.float64).T
    real = (jnp.arange(len(residual), dtype=jnp.int32) < rows).astype(jnp.float64)

    def of_output(
        root: Float[Array, " m"], left: Float[Array, " m"], kappa: Float[Array, ""], correlation: Float[Array, "m m"]
    ) -> Spectrum:
        known = kappa**2 * correlation + white * jnp.eye(len(root), dtype=jnp.float64)
        found = spectrum(known * root[:, None] * root[None], (left * root)[:, None], rows)
        silent = jnp.sum(jnp.where(root > 0, 0.0, real))
        return found._replace(padding=found.padding + silent)

    scale = jnp.ones(len(root), jnp.float64) if kappa is None else kappa
    found: Spectrum = jax.lax.map(
        lambda given: of_output(*given), (root, residual.astype(jnp.float64).T, scale, correlation)
    )
    return found


def best_scales(
    given: Spectrum,
    kappa: Float[Numbers, " dy"] | None,
    white: float,
    prior_std: float | None,
    floor: Float[Numbers, " dy"],
    typical: Float[Numbers, " dy"],
) -> MarginalLikelihoodFit:
    """Return what maximises the penalised marginal likelihood of every output.

    Args:
        given: residuals; of one basis for all outputs, or, with a leading axis, of one each.
        kappa: scale of the Gaussian process; None: it is chosen, too.
        white: w, its white variance.
        prior_std: log sigma ~ N(log typical, prior_std^2); None: sigma is `typical`.
        floor: smallest noise.
        typical: see `prior_std`.
    """
    floor, typical = (jnp.asarray(a).astype(jnp.float64) for a in (floor, typical))
    if kappa is None:
        scales = jnp.tile(jnp.geomspace(*SCALES)[None], (len(floor), 1))
        penalty = 0.5 * (jnp.log(scales / TYPICAL_SCALE) / SPREAD_OF_SCALES) ** 2
    else:
        scales = jnp.asarray(kappa).astype(jnp.float64)[:, None]
        penalty = jnp.zeros_like(scales)

    def of_output(
        values: Float[Array, " m"],
        turned: Float[Array, " m"],
        padding: Float[Array, ""],
        scales: Float[Array, " s"],
        penalty: Float[Array, " s"],
        floor: Float[Array, ""],
        typical: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        levels = jnp.exp(jnp.linspace(jnp.log(floor), jnp.log(jnp.maximum(1.0, 2 * floor)), NOISES))
        levels = levels if prior_std is not None else typical[None]

        def minus(scale: Float[Array, ""], penalty: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
            total = scale**2 * values + sigma**2 + white
            empty = padding * jnp.log(sigma**2 + white)
            data = 0.5 * jnp.sum(turned**2 / total + jnp.log(total)) - 0.5 * empty
            return data + penalty + 0.5 * (jnp.log(sigma / typical) / (prior_std or 1.0)) ** 2

        losses = jax.vmap(lambda s, p: jax.vmap(lambda sigma: minus(s, p, sigma))(levels))(scales, penalty)
        i, j = jnp.unravel_index(jnp.argmin(losses), losses.shape)
        return scales[i], levels[j], losses[i, j]

    shared = given.values.ndim == 1
    own = None if shared else 0
    turned = given.turned.T if shared else given.turned[..., 0]
    each = jax.vmap(of_output, in_axes=(own, 0, own, 0, 0, 0, 0))
    return MarginalLikelihoodFit(*each(given.values, turned, given.padding, scales, penalty, floor, typical))


def noise_of_smooth(
    correlation: Callable[[float], Float[Array, "m m"]],
    residual: Float[Numbers, "m dy"],
    rows: Int[Numbers, ""],
    white: float,
    prior_std: float,
    floor: Float[Numbers, " dy"],
    typical: Float[Numbers, " dy"],
    weights: Float[Numbers, "m dy"] | None = None,
    tells: Float[Numbers, "m dy"] | None = None,
) -> Float[Array, " dy"]:
    """Return what a smooth function leaves of the residuals, where neither its size nor its lengthscale is known.

    Where the declared lengthscale is short and the inputs have many dimensions no two rows tell of each other, and the
    marginal likelihood says nothing of the noise: longer ones are tried.

    Args:
        correlation: at the padded inputs, of a lengthscale so many times the declared one.
        residual: of their targets.
        rows: number of data; see `spectrum`.
        white: w; of rows with weights it is divided by them as the noise is: the scale is not known, and with it no basis.
        prior_std: of log sigma; see `best_scales`.
        floor: smallest noise.
        typical: its typical value.
        weights: of the rows; see `weighted_spectra`.
        tells: of the rows, too.
    """
    left = jnp.asarray(residual)
    found = [
        best_scales(
            weighted_spectra(correlation(f)[None], left, rows, weights, tells), None, white, prior_std, floor, typical
        )
        for f in LONGER
    ]
    noise, loss = (jnp.stack(values) for values in ([f.noise for f in found], [f.loss for f in found]))
    return jnp.take_along_axis(noise, jnp.argmin(loss, axis=0)[None], axis=0)[0]
