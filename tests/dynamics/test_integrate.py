"""RK4 against a nonlinear system with a known solution: its order, and what substeps are."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.dynamics.integrate import rk4_step

START, DURATION = np.array([0.3, 0.4]), 1.5


def limit_cycle(x: jax.Array) -> jax.Array:
    """Stuart-Landau oscillator: r' = r (1 - r^2), angle' = 1."""
    r2 = jnp.sum(x**2)
    return jnp.stack([x[0] * (1 - r2) - x[1], x[1] * (1 - r2) + x[0]])


def solution(start: np.ndarray, t: float) -> np.ndarray:
    r = (1 + (1 / np.sum(start**2) - 1) * np.exp(-2 * t)) ** -0.5
    angle = np.arctan2(start[1], start[0]) + t
    return r * np.array([np.cos(angle), np.sin(angle)])


def rk4(derivative: Callable[[jax.Array], jax.Array], x: jax.Array, dt: float, substeps: int) -> jax.Array:
    """So many equal steps."""
    return jax.lax.scan(lambda x, _: (free_step(derivative, x, dt / substeps), None), x, None, length=substeps)[0]


def free_step(
    derivative: Callable[[jax.Array], jax.Array], x: jax.Array, h: float, *, scanned: bool = False
) -> jax.Array:
    """A step of a system without inputs."""
    return rk4_step(lambda x, u: derivative(x), x, jnp.zeros((1, 0), x.dtype), h, scanned=scanned)


def test_order_is_four() -> None:
    counts = np.array([8, 16, 32, 64])
    expected = solution(START, DURATION)
    errors = [np.linalg.norm(rk4(limit_cycle, jnp.array(START), DURATION, int(n)) - expected) for n in counts]
    orders = -np.diff(np.log2(errors))
    np.testing.assert_allclose(orders[-2:], 4.0, atol=0.1)
    assert errors[-1] < 1e-8


def test_substeps_are_shorter_transitions() -> None:
    halves = jnp.array(START)
    for _ in range(2):
        halves = rk4(limit_cycle, halves, DURATION / 2, 3)
    np.testing.assert_allclose(rk4(limit_cycle, jnp.array(START), DURATION, 6), halves, rtol=1e-14)


def test_one_step_is_the_taylor_polynomial() -> None:
    # for x' = x one step is exactly 1 + h + h^2/2 + h^3/6 + h^4/24
    h = 0.5
    value = rk4(lambda x: x, jnp.ones(1), h, 1)
    np.testing.assert_allclose(value, 1 + h + h**2 / 2 + h**3 / 6 + h**4 / 24, rtol=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(dtype: jnp.dtype) -> None:
    assert rk4(limit_cycle, jnp.array(START, dtype), DURATION, 2).dtype == dtype


def test_stages_in_a_loop_are_the_same_step() -> None:
    """Values and derivatives, which is what the loop is for."""
    start = jnp.array(START)

    def step(x: jax.Array, scanned: bool) -> jax.Array:
        return free_step(limit_cycle, x, 0.3, scanned=scanned)

    np.testing.assert_allclose(step(start, True), step(start, False), rtol=1e-14)
    for slope in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(slope(step)(start, True), slope(step)(start, False), rtol=1e-13)
