"""The model of the measurement noise: one learned scale per output, above a floor."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Numbers = Array | np.ndarray  # assembled on the host, read by compiled programs


@dataclass(frozen=True)
class NoiseModel:
    """Observation noise, one scale per output, in normalised units: of Gaussian noise its standard deviation.

    sigma = floor + softplus(rho), learned with prior log sigma ~ N(log sigma_init, prior_std^2), or fixed at sigma_init.

    Args:
        learn: learn it, or keep the initial value.
        floor: smallest standard deviation when learned.
        measured_share: nor does it fall below this share of the measurement noise that the data YAML declares. 0.7 is the
            sine's or cosine's share of an angle's noise. (An estimate from the data is an upper bound, hence no floor.)
        marginal_share: nor, where it is learned from no more than 512 transitions (128 of a world), below this share of
            the noise with the largest marginal likelihood under the method's prior, or the initial value if that is less;
            of a prior without a simulator, whose lengthscale may be short, not below what a smooth function leaves either
            (`priors.marginal_likelihood`). A network that goes through every one of a few points would else learn that
            there is no noise; where all functions that the prior allows are integrated out, it cannot. 0 switches that off.
        prior_std: standard deviation of log sigma under its prior.
        least_init: sigma_init is the larger of the data's noise and this.
        rate: its learning rate as a multiple of the networks'. One number per output has far less to learn than a
            network, but at the same rate it needs thousands of steps per decade.
    """

    learn: bool = True
    floor: float = 1e-3
    measured_share: float = 0.7
    marginal_share: float = 1.0
    prior_std: float = 1.0
    least_init: float = 0.1
    rate: float = 10.0

    def start(
        self, measured: Float[Numbers, " dy"], declared: Float[Numbers, " dy"]
    ) -> tuple[Float[Numbers, " dy"], Float[Numbers, " dy"]]:
        """Return initial value and floor of sigma for a measured and a declared noise (0 where unknown)."""
        init = np.maximum(measured, self.least_init)
        return init, self.raised(self.floor, self.measured_share * np.asarray(declared), init)

    def raised(
        self, floor: Float[Numbers, " dy"] | float, least: Float[Numbers, " dy"], init: Float[Numbers, " dy"]
    ) -> Float[Numbers, " dy"]:
        """Return a floor of sigma that is `least` where that is higher, and below the initial value."""
        return jnp.clip(jnp.asarray(least), floor, 0.99 * jnp.asarray(init))

    def init(self, sigma: Float[Numbers, " dy"], floor: Float[Numbers, " dy"]) -> Float[Array, " dy"]:
        """Return rho for a standard deviation."""
        # inverse softplus, written so that it does not overflow for large arguments
        above = jnp.maximum(sigma - floor, 1e-6)
        return above + jnp.log(-jnp.expm1(-above))

    def std(self, rho: Float[Array, " dy"], floor: Float[Numbers, " dy"]) -> Float[Array, " dy"]:
        """Return sigma."""
        return jnp.asarray(floor) + jax.nn.softplus(rho)

    def log_prior(
        self, rho: Float[Array, " dy"], sigma_init: Float[Numbers, " dy"], floor: Float[Numbers, " dy"]
    ) -> Float[Array, ""]:
        """Log density of log sigma, up to a constant."""
        z = (jnp.log(self.std(rho, floor)) - jnp.log(sigma_init)) / self.prior_std
        return -0.5 * jnp.sum(z * z)
