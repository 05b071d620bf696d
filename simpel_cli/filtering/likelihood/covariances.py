"""Covariance of a state from row to row, and what a row counts for; trailing axes are points."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from simpel_cli.filtering.likelihood.small_matrices import along, apart, product

Square = Float[Array, "nx nx ..."]


def diagonal(sd: Float[Array, "nx ..."]) -> Square:
    """Covariance of independent numbers of these standard deviations."""
    return along(jnp.eye(len(sd)), sd.ndim - 1) * (sd**2)[None]


def of_half_a_row(q: Float[Array, "nx ..."], dt: float) -> Square:
    """Half of the process noise of a row: it enters before and after the flow."""
    return along(jnp.eye(len(q)), q.ndim - 1) * (q**2 * (dt / 2))[None]


def of_row(half: Square, pace: Float[Array, "..."] | None) -> Square:
    """Process noise of half a row that is `pace` dt long; None: dt."""
    return half if pace is None else half * pace[None, None]


def after(cov: Square, jacobian: Square, half: Square, sure: Bool[Array, ""]) -> Square:
    """Covariance at the next row."""
    reached = apart(sure, product, jacobian, cov + half)
    return product(reached, jnp.swapaxes(jacobian, 0, 1)) + half


def counted(weight: Array) -> tuple[Array, Array]:
    """Return whether measurements of so much weight count, 1 or 0, and by what their variance is larger."""
    there = weight > 0
    return jnp.where(there, 1.0, 0.0), 1 / jnp.where(there, weight, 1.0)
