"""Noise of the largest marginal likelihood about a known mean, a Gaussian process integrated out in closed form.

    y - mean ~ N(0, kappa^2 R + (w + sigma^2) I),    R = V diag(values) V'

Reference: Rasmussen and Williams (2006), eq. 5.8.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from simpel_cli.inference import NoiseModel, Numbers

NOISES = 41  # levels that are tried, from the floor to the targets' spread


class Spectrum(NamedTuple):
    """Residuals in the eigenbasis of the correlation at the training inputs, float64.

    Padding has eigenvalue 0 and no residual.
    """

    values: Float[Array, " m"]
    vectors: Float[Array, "m m"]
    turned: Float[Array, "m dy"]
    padding: Float[Array, ""]


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


def likeliest(
    given: Spectrum,
    kappa: Float[Numbers, " dy"],
    white: float,
    noise: NoiseModel,
    floor: Float[Numbers, " dy"],
    typical: Float[Numbers, " dy"],
) -> tuple[Float[Array, " dy"], Float[Array, " dy"]]:
    """Return the noise of every output with the largest penalised marginal likelihood, and minus its logarithm.

    Args:
        given: residuals.
        kappa: scale of the Gaussian process.
        white: w, its white variance.
        noise: its prior; one that is not learned is `typical`.
        floor: smallest noise.
        typical: its initial value.
    """

    def of_output(
        turned: Float[Array, " m"], kappa: Float[Array, ""], floor: Float[Array, ""], typical: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        levels = jnp.exp(jnp.linspace(jnp.log(floor), jnp.log(jnp.maximum(1.0, 2 * floor)), NOISES))
        levels = levels if noise.learn else typical[None]

        def minus(sigma: Float[Array, ""]) -> Float[Array, ""]:
            total = kappa**2 * given.values + sigma**2 + white
            empty = given.padding * jnp.log(sigma**2 + white)
            data = 0.5 * jnp.sum(turned**2 / total + jnp.log(total)) - 0.5 * empty
            return data + 0.5 * (jnp.log(sigma / typical) / noise.prior_std) ** 2

        losses = jax.vmap(minus)(levels)
        best = jnp.argmin(losses)
        return levels[best], losses[best]

    kappa, floor, typical = (jnp.asarray(a).astype(jnp.float64) for a in (kappa, floor, typical))
    return jax.vmap(of_output, in_axes=(1, 0, 0, 0))(given.turned, kappa, floor, typical)
