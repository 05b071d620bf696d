"""The derivatives of a filter beside central differences of the filter itself."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.filtering.setup import Setup

Pair = tuple[jax.Array, jax.Array]


def check_derivatives(plan: Setup, window: tuple[Any, ...], of_noise: float) -> None:
    """Compare them in every unknown, in a parameter up to what a row's Jacobian bends within the row.

    Args:
        plan: whose start is the point.
        window: y, ok, u, start, spread.
        of_noise: what a derivative in a noise may be off by, of the largest one.
    """
    coordinates = plan.coordinates
    y, ok, u, start, spread = window
    n_p, n_r, n_q = coordinates.sizes
    at = jnp.asarray(plan.start)
    p, noise = coordinates.physical(at)
    track, held = plan.rule.track(p, noise, y, ok, u, start, spread)

    @jax.jit
    def slopes() -> Pair:
        ways, pushes = plan.rule.pushes(p, jnp.arange(n_p + 1), track, held, u)  # beyond the last one: padding
        units = n_p + jnp.arange(n_r + n_q)
        louder = jax.vmap(lambda unit: jax.jvp(lambda z: coordinates.physical(z)[1], (at,), (unit,))[1])(
            jnp.zeros((n_r + n_q, len(at))).at[jnp.arange(n_r + n_q), units].set(1.0)
        )
        found: Pair = plan.rule.slopes(p, noise, louder, track, held, ok, ways, pushes)
        return found

    @jax.jit
    def exactly(z: jax.Array) -> Pair:
        other, _ = plan.rule.track(*coordinates.physical(z), y, ok, u, start, spread)
        return other.innovation, other.variance

    of_noise_first = slopes()
    speed = jax.jvp(lambda z: coordinates.physical(z)[0], (at,), (jnp.ones(len(at)),))[1]
    for i in range(n_p + n_r + n_q):
        step = jnp.zeros(len(at)).at[i].set(1.0)
        found = tuple(a[n_r + n_q + i] * speed[i] if i < n_p else a[i - n_p] for a in of_noise_first)
        ends = exactly(at + 1e-5 * step), exactly(at - 1e-5 * step)
        for ours, up, down, within in zip(found, *ends, (0.03, 0.3), strict=True):
            difference = np.asarray(up - down) / 2e-5
            within = within if i < n_p else of_noise
            np.testing.assert_allclose(ours, difference, rtol=1e-5, atol=1e-6 + within * np.abs(difference).max())
    for padded in of_noise_first:
        assert not padded[-1].any()
