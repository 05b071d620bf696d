"""Score of a Gaussian fitted to prior draws by moments.

    score(h) = -Sigma^-1 (h - mu),   Sigma = cov(samples) + known covariance

Where part of the prior is a Gaussian process, its covariance is known: it enters in closed form, as the law of an
independent sum, instead of being sampled. Exact when the prior is Gaussian, blind to a second mode when it is not.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError
from simpel_cli.scores.estimator import Estimator, Score


@dataclass(frozen=True)
class Gaussian(Estimator):
    """Moment-matched Gaussian score.

    Args:
        shrinkage: `none`, or `ledoit_wolf`: shrink the sampled covariance towards a multiple of the identity by the
            weight that minimises the expected squared error (for few draws in many dimensions).

    Reference: Ledoit and Wolf (2004), A well-conditioned estimator for large-dimensional covariance matrices.
    """

    shrinkage: str = "none"

    def __post_init__(self) -> None:
        if self.shrinkage not in ("none", "ledoit_wolf"):
            raise ConfigError(f"score.shrinkage: got {self.shrinkage!r}; allowed are none and ledoit_wolf.")

    def fitted(
        self,
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Score:
        """Return the score; see `Estimator`.

        The inverse is taken in float64: the draws of a parametric simulator span few directions, so Sigma is close to
        singular.
        """
        mean, sampled = moments(samples)
        if self.shrinkage == "ledoit_wolf":
            sampled = _ledoit_wolf((samples - mean[None]).astype(jnp.float64), sampled)
        factor = jnp.linalg.cholesky(sampled + covariance.astype(jnp.float64))
        precision = jax.scipy.linalg.cho_solve((factor, True), jnp.eye(len(mean), dtype=factor.dtype))
        return jax.tree_util.Partial(_linear, mean, precision)


def _linear(mean: Float[Array, " M"], precision: Float[Array, "M M"], h: Float[Array, "L M"]) -> Float[Array, "L M"]:
    return -((h - mean[None]).astype(precision.dtype) @ precision).astype(h.dtype)


def moments(samples: Float[Array, "N M"]) -> tuple[Float[Array, " M"], Float[Array, "M M"]]:
    """Return the mean of draws, and their unbiased covariance in float64."""
    mean = jnp.mean(samples, axis=0)
    centred = samples - mean[None]
    return mean, (centred.T @ centred / (samples.shape[0] - 1)).astype(jnp.float64)


def _ledoit_wolf(centred: Float[Array, "N M"], covariance: Float[Array, "M M"]) -> Float[Array, "M M"]:
    """Return (1 - w) S + w tr(S)/M I with the asymptotically optimal w."""
    n, m = centred.shape
    target = jnp.trace(covariance) / m * jnp.eye(m, dtype=covariance.dtype)
    distance = jnp.sum((covariance - target) ** 2)
    # sum_k |x_k x_k' - S|_F^2 = sum_k |x_k|^4 - 2 sum_k x_k' S x_k + n |S|_F^2
    fourth = jnp.sum(jnp.sum(centred**2, axis=1) ** 2)
    cross = jnp.sum((centred @ covariance) * centred)
    error = (fourth - 2 * cross + n * jnp.sum(covariance**2)) / n**2
    weight = jnp.clip(error / jnp.where(distance > 0, distance, 1.0), 0.0, 1.0)
    return (1 - weight) * covariance + weight * target
