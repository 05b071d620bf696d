"""Score of a kernel density estimate over prior draws, with what is known of the prior in its kernel.

    p(h) = 1/N sum_n N(h; mu + a (g_n - mu), C + b^2 S),    a^2 = 1 - b^2

with the draws g_n of the simulator, their moments mu and S, and the known covariance C of the Gaussian process. C is exact:
the sum of a draw and a Gaussian process is that Gaussian about the draw. Only the simulator's part is smoothed, by b, and the
centres shrink by a, so that mean and covariance of the estimate are those of the prior whatever b is: at b = 1 it is the
moment-matched Gaussian, at b = 0 the mixture of what was drawn.

Reference: Chacon, Duong and Wand (2011), Asymptotics for general multivariate kernel density derivative estimators, sec. 5.1
(rule for the gradient); Silverman (1986), Density estimation, eq. 4.7 (kernel in the draws' own covariance); West (1993),
Approximating posterior distributions by mixtures, sec. 2 (shrinkage); Scott (1992), Multivariate density estimation, eq. 6.42
(rule for the density).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError
from simpel_cli.scores.estimator import Estimator, Score
from simpel_cli.scores.gaussian import moments
from simpel_cli.scores.radial import squared_distances


@dataclass(frozen=True)
class KDE(Estimator):
    """Kernel density estimate.

    Args:
        bandwidth: b, in 0..1; or by a rule for a normal density in the d directions in which the draws spread more than
            the Gaussian process, d = tr S (S + C)^-1, since few parameters move all points together: `gradient`,
            (4/(N (d + 4)))^(1/(d + 6)), for the gradient of a density, or `scott`, N^(-1/(d + 4)), for the density.
    """

    bandwidth: float | str = "gradient"

    def __post_init__(self) -> None:
        if isinstance(self.bandwidth, str):
            if self.bandwidth not in ("gradient", "scott"):
                raise ConfigError(
                    f"score.bandwidth: got {self.bandwidth!r}; of kde allowed are gradient, scott and a number in 0..1."
                )
        elif not 0 < self.bandwidth <= 1:
            raise ConfigError(f"score.bandwidth: got {self.bandwidth}; of kde it must be above 0 and at most 1.")

    def fitted(
        self,
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Score:
        """Return the score; see `Estimator`."""
        mean, spread = moments(samples)
        known = covariance.astype(spread.dtype)
        b2 = self._squared(samples.shape[0], spread, known)
        factor = jnp.linalg.cholesky(b2 * spread + known)
        to_white = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(mean), dtype=factor.dtype), lower=True)
        shrunk = jnp.sqrt(1 - b2) * (samples - mean[None]).astype(spread.dtype)
        # many draws, of size 1: they need no more digits than the samples have
        return jax.tree_util.Partial(_pull, mean, to_white, (shrunk @ to_white.T).astype(samples.dtype))

    def _squared(self, n: int, spread: Float[Array, "M M"], known: Float[Array, "M M"]) -> Float[Array, ""]:
        if not isinstance(self.bandwidth, str):
            return jnp.asarray(self.bandwidth**2, spread.dtype)
        factor = jnp.linalg.cholesky(spread + known)
        # tr S (S + C)^-1 = M - tr C (S + C)^-1
        rest = jnp.trace(jax.scipy.linalg.cho_solve((factor, True), known))
        d = jnp.clip(spread.shape[0] - rest, 1.0, None)
        if self.bandwidth == "scott":
            return n ** (-2 / (d + 4))
        return (4 / (n * (d + 4))) ** (2 / (d + 6))


def _pull(
    mean: Float[Array, " M"], to_white: Float[Array, "M M"], centres: Float[Array, "N M"], h: Float[Array, "L M"]
) -> Float[Array, "L M"]:
    """Return where the mixture of white Gaussians about the centres is denser."""
    here = ((h - mean[None]).astype(to_white.dtype) @ to_white.T).astype(centres.dtype)
    weight = jax.nn.softmax(-squared_distances(here, centres) / 2, axis=1)
    return ((weight @ centres - here).astype(to_white.dtype) @ to_white).astype(h.dtype)
