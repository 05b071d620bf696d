"""Maximum a posteriori in function space: every particle climbs the posterior on its own.

One particle is the most probable function, several from different beginnings a deep ensemble under the same prior.

Reference: Wolpert (1993), Bayesian backpropagation over i-o functions rather than weights; Lakshminarayanan, Pritzel and
Blundell (2017), Simple and scalable predictive uncertainty estimation using deep ensembles.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.methods.function_space import FunctionSpace


@dataclass(frozen=True)
class FunctionMAP(FunctionSpace):
    """Function-space MAP; `particles` of it are an ensemble."""

    def velocity(
        self, h: Float[Array, "L *d"], score: Float[Array, "L *d"]
    ) -> tuple[Float[Array, "L *d"], Float[Array, ""]]:
        """Return the score itself; see `FunctionSpace.velocity`."""
        return score, jnp.zeros((), h.dtype)
