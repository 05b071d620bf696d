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
from simpel_cli.scores.gaussian import moments
from simpel_cli.scores.radial import squared_distances


@dataclass(frozen=True)
class KDE:
    """Kernel density estimate.

    Args:
        bandwidth: b, in 0..1; or by a rule for a normal density in the d directions in which the draws spread more than
            the Gaussian process, d = tr S (S + C)^-1, since few parameters move all points together: `gradient`,
            (4/(N (d + 4)))^(1/(d + 6)), for the gradient of a density, or `scott`, N^(-1/(d + 4)), for the density.
    """

    bandwidth: float | str = "gradient"

    gap_draws = False

    def __post_init__(self) -> None:
        if isinstance(self.bandwidth, str):
            if self.bandwidth not in ("gradient", "scott"):
                raise ConfigError(
                    f"score.bandwidth: got {self.bandwidth!r}; of kde allowed are gradient, scott and a number in 0..1."
                )
        elif not 0 < self.bandwidth <= 1:
            raise ConfigError(f"score.bandwidth: got {self.bandwidth}; of kde it must be above 0 and at most 1.")

    def __call__(
        self,
        h: Float[Array, "L M"],
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Float[Array, "L M"]:
        """Return the score of the joint log density of one output at M points; see `ScoreEstimator`."""
        mean, spread = moments(samples)
        known = covariance.astype(spread.dtype)
        b2 = self._squared(samples.shape[0], spread, known)
        factor = jnp.linalg.cholesky(b2 * spread + known)
        shrunk = jnp.sqrt(1 - b2) * (samples - mean[None]).astype(spread.dtype)
        here = (h - mean[None]).astype(spread.dtype)
        white = jax.scipy.linalg.solve_triangular(factor, jnp.concatenate([shrunk, here]).T, lower=True).T
        n = samples.shape[0]
        weight = jax.nn.softmax(-squared_distances(white[n:], white[:n]) / 2, axis=1)
        pull = weight @ white[:n] - white[n:]
        return jax.scipy.linalg.solve_triangular(factor, pull.T, lower=True, trans=1).T.astype(h.dtype)

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
