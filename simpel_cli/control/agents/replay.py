"""Transitions that were seen, in a ring of fixed size."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


class Transitions(NamedTuple):
    """Steps in a world.

    Args:
        seen: observations before.
        action: in [-1, 1].
        reward: earned.
        then: observations after.
        alive: 0 where the episode ended there, other than by its horizon.
    """

    seen: Float[Array, "*n do"]
    action: Float[Array, "*n du"]
    reward: Float[Array, "*n"]
    then: Float[Array, "*n do"]
    alive: Float[Array, "*n"]


class Replay(NamedTuple):
    """The ring, and how many transitions were put into it."""

    ring: Transitions
    put: Int[Array, ""]


def empty(capacity: int, dim_o: int, dim_u: int, dtype: jnp.dtype) -> Replay:
    """Return a ring of zeros."""
    of = lambda *shape: jnp.zeros((capacity, *shape), dtype)  # noqa: E731
    return Replay(Transitions(of(dim_o), of(dim_u), of(), of(dim_o), of()), jnp.int32(0))


def put(replay: Replay, new: Transitions) -> Replay:
    """Put transitions in place of the oldest; their number divides the capacity."""
    begin = replay.put % len(replay.ring.reward)
    ring = jax.tree.map(lambda old, a: jax.lax.dynamic_update_slice_in_dim(old, a, begin, 0), replay.ring, new)
    return Replay(ring, replay.put + len(new.reward))


def batches(key: PRNGKeyArray, replay: Replay, number: int, size: int) -> Transitions:
    """Draw transitions with replacement; leaves (number, size, ...)."""
    filled = jnp.minimum(replay.put, len(replay.ring.reward))
    at = jax.random.randint(key, (number, size), 0, filled, jnp.int32)
    return jax.tree.map(lambda a: a[at], replay.ring)
