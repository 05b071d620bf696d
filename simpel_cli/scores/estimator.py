"""What every score estimator is: fitted to prior draws once, then asked at function values as often as wanted."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import jax
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError

# a jax.tree_util.Partial: its arrays are a tree, so that those of many sets and outputs can be stacked
Score = Callable[[Float[Array, "L M"]], Float[Array, "L M"]]


class Estimator(ABC):
    """Estimator of the score of the joint log density of one output at M points; the caller vmaps over outputs."""

    gap_draws = False  # not a field: whether draws of the Gaussian part are needed, beside its covariance

    @abstractmethod
    def fitted(
        self,
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Score:
        """Return the score as a `jax.tree_util.Partial`; all work that function values have no part in is done here.

        Args:
            samples: draws of the simulator's part of the prior.
            covariance: of the Gaussian part, which is independent of it.
            gap: draws of the Gaussian part, where they are needed; None: it is 0.
        """

    def __call__(
        self,
        h: Float[Array, "L M"],
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Float[Array, "L M"]:
        """Return the scores at L function values; see `fitted`."""
        return self.fitted(samples, covariance, gap)(h)


def fitted(
    estimator: Callable[..., Array],
    samples: Float[Array, "N M"],
    covariance: Float[Array, "M M"],
    gap: Float[Array, "N M"] | None,
) -> Score:
    """Return the score of an estimator; one of a user's with a `__call__` of its own keeps its draws, and is called.

    Raises:
        ConfigError: `fitted` returns something else than a `jax.tree_util.Partial`.
    """
    if isinstance(estimator, Estimator) and type(estimator).__call__ is Estimator.__call__:
        score = estimator.fitted(samples, covariance, gap)
        if not isinstance(score, jax.tree_util.Partial):
            raise ConfigError(
                f"score: {type(estimator).__name__}.fitted returned a {type(score).__name__}; it must return a "
                "jax.tree_util.Partial of a function and arrays, so that those of many sets of points can be stacked."
            )
        return score
    return jax.tree_util.Partial(_called, jax.tree_util.Partial(estimator), samples, covariance, gap)


def _called(
    estimator: Callable[..., Array], samples: Array, covariance: Array, gap: Array | None, h: Float[Array, "L M"]
) -> Float[Array, "L M"]:
    return estimator(h, samples, covariance, gap)
