"""The derivatives of a filter beside central differences of the filter itself."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.filtering.likelihood.track import Track
from simpel_cli.filtering.setup import Setup

Pair = tuple[jax.Array, jax.Array]


def check_derivatives(
    plan: Setup, window: tuple[Any, ...], of_noise: float
) -> tuple[Track, Callable[[jax.Array, jax.Array], Pair], Callable[[jax.Array, jax.Array], Pair]]:
    """Compare them in every unknown, in a parameter up to what a row's Jacobian bends within the row.

    Args:
        plan: whose start is the point.
        window: y, ok, u, start, spread.
        of_noise: what a derivative in a noise may be off by, of the largest one.

    Returns:
        The track, what moves with a parameter, and its slope.
    """
    coordinates = plan.coordinates
    y, ok, u, start, spread = window
    n_p, n_r, n_q = coordinates.sizes
    at = jnp.asarray(plan.start)
    p, noise = coordinates.physical(at)
    track, held = plan.rule.track(p, noise, y, ok, u, start, spread)

    ways, pushes = jax.jit(plan.rule.pushes)(p, jnp.arange(n_p + 1), track, held, u)  # beyond the last one: padding

    def louder(z: jax.Array) -> Pair:
        return plan.rule.shifted(p, coordinates.physical(z)[1], track, held, ok, spread, ways, None, jnp.zeros(()))

    def moved(by: jax.Array, row: jax.Array) -> Pair:
        push = jax.tree.map(lambda a: a[row], pushes)
        return plan.rule.shifted(p, noise, track, held, ok, spread, ways, push, by)

    @jax.jit
    def exactly(z: jax.Array) -> Pair:
        other, _ = plan.rule.track(*coordinates.physical(z), y, ok, u, start, spread)
        return other.innovation, other.variance

    @jax.jit
    def slope(step: jax.Array, row: jax.Array) -> Pair:
        speed = jax.jvp(lambda z: coordinates.physical(z)[0], (at,), (step,))[1]
        by = jnp.where(row < n_p, speed[jnp.minimum(row, n_p - 1)], 1.0)
        return jax.jvp(lambda by: moved(by, row), (jnp.zeros(()),), (by,))[1]

    for i in range(n_p + n_r + n_q):
        step = jnp.zeros(len(at)).at[i].set(1.0)
        found = slope(step, jnp.asarray(i)) if i < n_p else jax.jvp(louder, (at,), (step,))[1]
        ends = exactly(at + 1e-5 * step), exactly(at - 1e-5 * step)
        for ours, up, down, within in zip(found, *ends, (0.03, 0.3), strict=True):
            difference = np.asarray(up - down) / 2e-5
            within = within if i < n_p else of_noise
            np.testing.assert_allclose(ours, difference, rtol=1e-5, atol=1e-6 + within * np.abs(difference).max())
    return track, moved, slope
