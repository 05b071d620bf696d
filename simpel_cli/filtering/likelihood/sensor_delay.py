"""What a late sensor reads, from the motion at hand (`simpel_cli.dynamics.late_readings`), at many points at once."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.dynamics.late_readings import JUMPS, echo, echo_of_curvature

__all__ = ["JUMPS", "Motion", "back", "no_jumps", "pushed", "still_shown"]


class Motion(NamedTuple):
    """How the states move at a point in time: their rates and those rates' rates; or derivatives of these.

    The latter are A f for states, A: slope of the rates f, and where inputs rise or fall between rows what that adds.
    """

    rate: Float[Array, "nx ..."]
    bend: Float[Array, "nx ..."]


def back(d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], motion: Motion) -> Float[Array, "ny nx ..."]:
    """Return how far every sensor looks back along the smooth motion, in the states."""
    d, tau = d[:, None], tau[:, None]
    return -(d + tau) * motion.rate[None] + (0.5 * d**2 + d * tau + tau**2) * motion.bend[None]


def pushed(
    jumps: Float[Array, "K 2 ny ..."], prompt: Float[Array, "ny nx ..."], before: Motion, now: Motion
) -> Float[Array, "K 2 ny ..."]:
    """Add the jump at the start of a row, where a motion goes over into another; prompt: slope of the sensors."""
    latest = jnp.stack([jnp.sum(prompt * (to - was)[None], axis=1) for was, to in zip(before, now, strict=True)])
    return jnp.concatenate([latest[None], jumps[:-1]])


def no_jumps(ny: int, x: Float[Array, "nx ..."]) -> Float[Array, "K 2 ny ..."]:
    """Return the start of a record, before which nothing jumped."""
    return jnp.zeros((JUMPS, 2, ny, *x.shape[1:]), x.dtype)


def still_shown(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], jumps: Float[Array, "K 2 ny ..."], dt: float
) -> Float[Array, "ny ..."]:
    """Return what every sensor still shows of the time before its rates and their rates jumped; jumps: the latest first."""
    return echo(d, tau, jumps[:, 0], dt) - echo_of_curvature(d, tau, jumps[:, 1], dt)
