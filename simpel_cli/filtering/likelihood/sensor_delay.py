"""What a sensor reads that is late, from the motion at hand: a delay d and a lag tau act together as exp(-d s)/(1 + tau s).

Along a smooth motion that is, to second order,

    y - (d + tau) y' + (d^2/2 + d tau + tau^2) y''

which holds while d and tau are short against the motion (the next term is about tau^3 times the third derivative). Inputs
are held from a row to the next, so y' jumps at the rows. A jump J at age a adds what the motion since then does not show,

    J tau exp((d - a)/tau)  where d <= a,    J (d + tau - a)  where the delay reaches behind it.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.filtering.likelihood.small_matrices import along, product

JUMPS = 4  # rows that are looked back on


def back(
    d: Float[Array, "ny ..."],
    tau: Float[Array, "ny ..."],
    rate: Float[Array, "nx ..."],
    rate_x: Float[Array, "nx nx ..."],
) -> Float[Array, "ny nx ..."]:
    """Return how far every sensor looks back along the smooth motion, in the states."""
    d, tau = d[:, None], tau[:, None]
    return -(d + tau) * rate[None] + (0.5 * d**2 + d * tau + tau**2) * product(rate_x, rate[:, None])[None, :, 0]


def echo(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], jumps: Float[Array, "K ny ..."], dt: float
) -> Float[Array, "ny ..."]:
    """Return what every sensor still shows of the time before its rates jumped; jumps: the latest first."""
    ages = jnp.arange(1, JUMPS + 1, dtype=jumps.dtype) * dt
    age = along(ages, d.ndim) - d[None]
    faded = tau[None] * jnp.exp(-jnp.maximum(age, 0.0) / (tau[None] + 1e-9 * dt))
    return jnp.sum(jnp.where(age >= 0, faded, tau[None] - age) * jumps, axis=0)


def pushed(
    jumps: Float[Array, "K ny ..."], prompt: Float[Array, "ny nx ..."], before: Float[Array, "nx ..."],
    now: Float[Array, "nx ..."],
) -> Float[Array, "K ny ..."]:  # fmt: skip
    """Add the jump at the start of a row, where the rate goes from one value to another; prompt: slope of the sensors."""
    return jnp.concatenate([jnp.sum(prompt * (now - before)[None], axis=1)[None], jumps[:-1]])


def no_jumps(ny: int, x: Float[Array, "nx ..."]) -> Float[Array, "K ny ..."]:
    """Return the start of a record, before which nothing jumped."""
    return jnp.zeros((JUMPS, ny, *x.shape[1:]), x.dtype)
