"""Repulsive ensemble in function space: the Wasserstein gradient flow of the same posterior, its density by a kernel.

    v_i = s_i - grad log sum_l K_li = s_i + sum_l K_li (h_i - h_l) / (s^2 sum_l K_li)

Every particle follows its own score, not a mean over neighbours as in Stein's flow, and the push away is normalised by how
crowded it is there.

Reference: D'Angelo and Fortuin (2021), Repulsive deep ensembles are Bayesian, eqs. 11 and 16; Liu et al. (2019), Understanding
and accelerating particle-based variational inference.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.methods.fsvgd import between, kernel_between, refuse_bandwidth
from simpel_cli.methods.function_space import FunctionSpace


@dataclass(frozen=True)
class Repulsive(FunctionSpace):
    """Repulsive ensemble.

    Args:
        bandwidth: s of the kernel on all function values of a step; or `median`: K = 1/2 at the median distance between
            particles of each step.
    """

    bandwidth: float | str = "median"

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_bandwidth(self.bandwidth)

    def velocity(
        self, h: Float[Array, "L *d"], score: Float[Array, "L *d"]
    ) -> tuple[Float[Array, "L *d"], Float[Array, ""]]:
        """Return the flow's velocity; see `FunctionSpace.velocity`."""
        n = h.shape[0]
        flat = h.reshape(n, -1)
        kernel, width_squared = kernel_between(flat, self.bandwidth)
        crowd = jnp.sum(kernel, axis=0)
        push = (crowd[:, None] * flat - kernel.T @ flat) / (width_squared * crowd[:, None])
        return score + push.reshape(h.shape), between(kernel)
