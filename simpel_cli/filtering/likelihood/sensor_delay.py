"""What a late sensor reads, from the motion at hand (`simpel_cli.dynamics.late_readings`), at many points at once."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.dynamics.late_readings import JUMPS, echo
from simpel_cli.filtering.likelihood.small_matrices import product

__all__ = ["JUMPS", "back", "echo", "no_jumps", "pushed"]


def back(
    d: Float[Array, "ny ..."],
    tau: Float[Array, "ny ..."],
    rate: Float[Array, "nx ..."],
    rate_x: Float[Array, "nx nx ..."],
) -> Float[Array, "ny nx ..."]:
    """Return how far every sensor looks back along the smooth motion, in the states."""
    d, tau = d[:, None], tau[:, None]
    return -(d + tau) * rate[None] + (0.5 * d**2 + d * tau + tau**2) * product(rate_x, rate[:, None])[None, :, 0]


def pushed(
    jumps: Float[Array, "K ny ..."], prompt: Float[Array, "ny nx ..."], before: Float[Array, "nx ..."],
    now: Float[Array, "nx ..."],
) -> Float[Array, "K ny ..."]:  # fmt: skip
    """Add the jump at the start of a row, where the rate goes from one value to another; prompt: slope of the sensors."""
    return jnp.concatenate([jnp.sum(prompt * (now - before)[None], axis=1)[None], jumps[:-1]])


def no_jumps(ny: int, x: Float[Array, "nx ..."]) -> Float[Array, "K ny ..."]:
    """Return the start of a record, before which nothing jumped."""
    return jnp.zeros((JUMPS, ny, *x.shape[1:]), x.dtype)
