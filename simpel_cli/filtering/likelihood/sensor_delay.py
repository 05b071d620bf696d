"""What a late sensor reads, from the motion at hand (`simpel_cli.dynamics.late_readings`), at many points at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.dynamics.late_readings import JUMPS, ORDERS, ages, shares, signed_moments
from simpel_cli.filtering.likelihood.small_matrices import applied

__all__ = [
    "JUMPS",
    "Motion",
    "back",
    "moving",
    "no_jumps",
    "of_rates",
    "pushed",
    "pushed_within",
    "shares_of",
    "still_shown",
]


class Motion(NamedTuple):
    """How the states move at a point in time: their first three derivatives in time; or derivatives of these.

    The second and the third are A f and A A f for states, A: slope of the rates f, and what inputs add that move between rows.
    `rest` is what the slope's own change adds to the third: a difference of the second over the row before.
    """

    rate: Float[Array, "nx ..."]
    bend: Float[Array, "nx ..."]
    turn: Float[Array, "nx ..."]
    rest: Float[Array, "nx ..."]

    @property
    def orders(self) -> Float[Array, "orders nx ..."]:
        """All three; of a motion that goes on as before, the third with its rest."""
        return jnp.stack([self.rate, self.bend, self.turn + self.rest])

    def since(self, begin: "Motion", step: Array | float) -> "Motion":
        """Return this motion at the end of a step, with its rest; `begin`: of the step; `step`: its length, s."""
        return self._replace(rest=(self.bend - begin.bend) / step - (self.turn + begin.turn) / 2)


def moving(rate: Array, rate_x: Array, driven: Array | float = 0.0) -> Motion:
    """Return a motion without a rest; `driven`: what inputs that move add to the second derivative."""
    bend = applied(rate_x, rate) + driven
    return Motion(rate, bend, applied(rate_x, bend), jnp.zeros_like(rate))


def back(d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], motion: Motion) -> Float[Array, "ny nx ..."]:
    """Return how far every sensor looks back along the smooth motion, in the states."""
    return jnp.sum(signed_moments(d, tau)[:, :, None] * motion.orders[:, None], axis=0)


def pushed(
    jumps: Float[Array, "K orders ny ..."], prompt: Float[Array, "ny nx ..."], before: Motion, now: Motion
) -> Float[Array, "K orders ny ..."]:
    """Add the jump at the start of a row, where a motion goes over into another; prompt: slope of the sensors."""
    each = zip(before[:ORDERS], now[:ORDERS], strict=True)
    latest = jnp.stack([jnp.sum(prompt * (to - was)[None], axis=1) for was, to in each])
    return jnp.concatenate([latest[None], jumps[:-1]])


def pushed_within(
    jumps: Float[Array, "K orders ny ..."],
    prompt: Float[Array, "ny nx ..."],
    change: Float[Array, "n nx ..."],
    rate_x: Float[Array, "nx nx ..."],
) -> Float[Array, "K orders ny ..."]:
    """Add the jumps between the steps of a row, the first of which comes first; change: of the rates there."""
    return jnp.concatenate([of_rates(prompt, change, rate_x)[::-1], jumps])[: len(jumps)]


def of_rates(
    prompt: Float[Array, "ny nx ..."], change: Float[Array, "n nx ..."], rate_x: Float[Array, "nx nx ..."]
) -> Float[Array, "n orders ny ..."]:
    """Return how the derivatives of what is read jump where the rates do; rate_x: slope of these."""
    each = [change]
    for _ in range(1, ORDERS):
        each.append(jax.vmap(lambda one: applied(rate_x, one))(each[-1]))
    return jnp.stack([jnp.sum(prompt[None] * order[:, None], axis=2) for order in each], axis=1)


def no_jumps(ny: int, x: Float[Array, "nx ..."], count: int = JUMPS) -> Float[Array, "K orders ny ..."]:
    """Return the start of a record, before which nothing jumped."""
    return jnp.zeros((count, ORDERS, ny, *x.shape[1:]), x.dtype)


def still_shown(
    shares: Float[Array, "K orders ny ..."], jumps: Float[Array, "K orders ny ..."]
) -> Float[Array, "ny ..."]:
    """Return what every sensor still shows of the time before its motion jumped; shares: of `shares_of`."""
    return jnp.sum(shares * jumps, axis=(0, 1))


def shares_of(
    d: Float[Array, "ny ..."], tau: Float[Array, "ny ..."], count: int, dt: float, parts: int = 1
) -> Float[Array, "K orders ny ..."]:
    """Return what every sensor still shows of jumps of one.

    Args:
        d: delay, s.
        tau: lag, s.
        count: of the jumps, the latest first.
        dt: distance of the rows, s.
        parts: of every row, between which a motion jumps; what jumped within the last one is in the difference that
            `Motion.since` takes for a rest, and is taken out of it.
    """
    ago = ages(count, dt / parts, d.dtype)
    found = shares(d, tau, ago)
    if parts == 1:
        return found
    within, moment = slice(parts - 1), signed_moments(d, tau)[2][None]
    left = (0.5 - ago[within] / dt).reshape(-1, *(1,) * d.ndim)
    return found.at[within, 1].add(-moment / dt).at[within, 2].add(moment * left)
