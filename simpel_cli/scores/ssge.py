"""Spectral Stein gradient estimator: the score expanded in eigenfunctions of a kernel under the prior.

    s(h) = s_0(h) + sum_j beta_j psi_j(h),    beta_j = -E[ grad psi_j + psi_j s_0 ]

by Stein's identity, with Nystroem eigenfunctions psi_j of the kernel at P landmarks and the expectation over all N draws. With
s_0 the moment-matched Gaussian score (`baseline`), the expansion holds only what is not Gaussian; the published estimator has
s_0 = 0 and must build directions in which a prior is narrow from functions that do not see them.

Reference: Shi, Sun and Zhu (2018), A spectral approach to gradient estimation for implicit distributions, eqs. 10-14.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.scores import radial
from simpel_cli.scores.estimator import Estimator, Score
from simpel_cli.scores.gaussian import Gaussian


@dataclass(frozen=True)
class SSGE(Estimator):
    """Spectral estimator.

    Args:
        kernel: `imq` or `squared_exponential`.
        bandwidth: of the kernel; `median`: the median distance between draws.
        share: of the spectrum that the eigenfunctions hold.
        rank: most eigenfunctions.
        landmarks: draws P at which they are computed, at most.
        eta: added to the eigenvalues of the kernel matrix, as a share of its mean one times P.
        baseline: `gaussian`, or `none`: as published.
    """

    kernel: str = "imq"
    bandwidth: float | str = "median"
    share: float = 0.98
    rank: int = 32
    landmarks: int = 256
    eta: float = 1e-3
    baseline: str = "gaussian"

    gap_draws = True

    def __post_init__(self) -> None:
        radial.check(self.kernel, self.bandwidth, self.baseline)
        if not 0 < self.share <= 1:
            raise ConfigError(f"score.share: got {self.share}; it must be above 0 and at most 1.")
        check_at_least_one("score", self, ("rank", "landmarks"))
        if not self.eta >= 0:
            raise ConfigError(f"score.eta: got {self.eta}; it must be at least 0.")

    def fitted(
        self,
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Score:
        """Return the score; see `Estimator`."""
        draws = samples if gap is None else samples + gap
        n = draws.shape[0]
        landmarks = min(self.landmarks, n)
        middle = jnp.mean(draws, axis=0)[None]
        s = radial.width(self.bandwidth, 1.0, draws - middle)
        x = (draws - middle) / s
        nodes = x[:landmarks]
        gram = radial.profile(self.kernel, radial.squared_distances(nodes, nodes)).f
        values, vectors = radial.subspace(gram, min(self.rank, landmarks), jax.random.key(0))
        values = jnp.maximum(values, jnp.finfo(values.dtype).eps * landmarks)
        # the trace of the kernel matrix is the number of landmarks
        before = jnp.cumsum(values) - values
        kept = (before < self.share * landmarks).astype(values.dtype)
        scale = kept * landmarks**0.5 / (values + self.eta * landmarks)
        modes = vectors * scale[None]  # psi_j(x) = k(x, nodes) modes_j

        at_draws = radial.profile(self.kernel, radial.squared_distances(x, nodes))
        slope = 2 * at_draws.f1
        # sum over draws of the gradient of k(x, node)
        gradient = slope.T @ x - jnp.sum(slope, axis=0)[:, None] * nodes
        beta = -modes.T @ gradient / n
        start = None
        if self.baseline == "gaussian":
            start = Gaussian().fitted(samples, covariance)
            beta = beta - modes.T @ (at_draws.f.T @ (s * start(draws))) / n
        return jax.tree_util.Partial(self._at, middle, s, nodes, modes @ beta, start)

    def _at(
        self,
        middle: Float[Array, "1 M"],
        s: Float[Array, ""],
        nodes: Float[Array, "P M"],
        weights: Float[Array, "P M"],
        start: Score | None,
        h: Float[Array, "L M"],
    ) -> Float[Array, "L M"]:
        here = radial.profile(self.kernel, radial.squared_distances((h - middle) / s, nodes)).f
        found = here @ weights / s
        return found if start is None else start(h) + found
