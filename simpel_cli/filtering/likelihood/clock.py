"""What stands behind the inputs of a row: the step to the next row, in dt, and how long before its row each value was measured.

Where the clock is even and every value was measured at its row, nothing stands there.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def pace_of(u: Array, nu: int) -> Array | None:
    """Return the step to the next row, in dt; u: of a row, (nu, ...) or more; None: it is dt."""
    return u[nu] if u.shape[0] > nu else None


def early_of(u: Array, nu: int) -> Array | None:
    """Return how long before its row each value was measured, (ny, ...); u: of a row, (nu, ...) or more; None: at it."""
    return u[nu + 1 :] if u.shape[0] > nu else None


def at_row(sensors: Callable[[Array], Any], before: Array, now: Array, nu: int) -> Any:
    """Return what sensors read with the input that acts from the row on; measured before it, with what acted until then.

    So a transition reads them, and what is simulated: an output that has a held input follows it at once.
    """
    early = early_of(now, nu)
    if early is None:
        return sensors(now)
    return jax.tree.map(lambda then, at: chosen(early, then, at), sensors(before), sensors(now))


def chosen(early: Array, then: Array, at: Array) -> Array:
    """Return what was read of each sensor, (ny, ...): before the row, or at it."""
    return jnp.where((early > 0).reshape(early.shape[:1] + (1,) * (at.ndim - early.ndim) + early.shape[1:]), then, at)
