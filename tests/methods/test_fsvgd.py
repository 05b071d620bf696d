"""FSVGD: the velocity by hand, known targets, and whole networks against exact Gaussian-process posteriors."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.stats import skew

from simpel_cli.methods.fsvgd import stein_velocity
from simpel_cli.methods.function_space import distinct_rows


def test_two_particles_by_hand() -> None:
    a, s1, s2, width = 1.5, 0.7, -2.0, 1.2
    k = np.exp(-(a**2) / (2 * width**2))
    velocity, off_diagonal = stein_velocity(jnp.array([[0.0], [a]]), jnp.array([[s1], [s2]]), width)
    first = (s1 + k * s2 - k * a / width**2) / 2  # the particle on the left is pushed to the left
    second = (s2 + k * s1 + k * a / width**2) / 2
    np.testing.assert_allclose(velocity[:, 0], [first, second], rtol=1e-14)
    np.testing.assert_allclose(off_diagonal, k, rtol=1e-14)


def test_velocity_is_the_formula() -> None:
    """phi_i = 1/L sum_l [K_li s_l + grad_{h_l} K_li], gradients by automatic differentiation, points and outputs flattened."""
    rng = np.random.default_rng(0)
    h, score = jnp.asarray(rng.normal(size=(5, 3, 2))), jnp.asarray(rng.normal(size=(5, 3, 2)))
    width = 1.7

    def kernel(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.exp(-jnp.sum((a - b) ** 2) / (2 * width**2))

    expected = [
        sum(kernel(h[j], h[i]) * score[j] + jax.grad(kernel)(h[j], h[i]) for j in range(5)) / 5 for i in range(5)
    ]
    np.testing.assert_allclose(stein_velocity(h, score, width)[0], jnp.stack(expected), rtol=1e-12, atol=1e-14)


def test_without_score_particles_repel_each_other() -> None:
    h = jnp.array([[-1.0, 0.0], [0.5, 0.2], [1.0, -0.3]])
    velocity = stein_velocity(h, jnp.zeros_like(h), 1.0)[0]
    spread = jnp.sum((h - jnp.mean(h, axis=0, keepdims=True)) * velocity)
    assert spread > 0.1
    np.testing.assert_allclose(jnp.sum(velocity, axis=0), 0, atol=1e-15)  # forces between particles balance


def moved(start: np.ndarray, score: Any, bandwidth: float, steps: int = 3000) -> np.ndarray:
    """Particles after gradient steps along the velocity."""
    rule = optax.adam(optax.exponential_decay(0.05, steps, 0.01))

    def body(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        h, state = carry
        velocity = stein_velocity(h, score(h), bandwidth)[0]
        with jax.numpy_dtype_promotion("standard"):
            updates, state = rule.update(-velocity, state)
        return h + updates, state

    h = jnp.asarray(start)
    return np.asarray(jax.jit(lambda h: jax.lax.fori_loop(0, steps, body, (h, rule.init(h)))[0])(h))


@pytest.mark.parametrize("bandwidth", [0.5, 1.0])
def test_standard_normal(bandwidth: float) -> None:
    start = np.random.default_rng(1).uniform(2, 3, (50, 1))
    h = moved(start, lambda h: -h, bandwidth)
    assert abs(h.mean()) < 0.01
    assert abs(h.std() - 1) < 0.05


def test_the_published_update_would_be_far_too_narrow() -> None:
    """Repulsion divided by L once more than the driving term, as published, is what the standard deviation catches."""
    start = np.random.default_rng(1).uniform(2, 3, (20, 1))
    h = moved(start, lambda h: -20 * h, 1.0)  # drive L times too strong: the same thing
    assert h.std() < 0.3


def test_asymmetric_target() -> None:
    """Gumbel: density exp(-x - exp(-x)), mean 0.5772, variance pi^2/6, skewness 1.14. Started skewed the wrong way."""
    start = -np.random.default_rng(2).exponential(1.0, (50, 1)) + 3
    assert skew(start[:, 0]) < -0.5
    h = moved(start, lambda h: jnp.exp(-h) - 1, 0.7)[:, 0]
    assert abs(h.mean() - np.euler_gamma) < 0.05
    assert abs(h.std() - np.pi / 6**0.5) < 0.08 * np.pi / 6**0.5
    assert 0.6 < skew(h) < 1.4


def test_correlated_gaussian() -> None:
    covariance, mean = np.array([[1.0, 0.8], [0.8, 1.5]]), np.array([1.0, -2.0])
    precision = jnp.asarray(np.linalg.inv(covariance))
    h = moved(np.random.default_rng(3).normal(size=(50, 2)), lambda h: -(h - mean[None]) @ precision, 1.0)
    np.testing.assert_allclose(h.mean(axis=0), mean, atol=0.03)
    np.testing.assert_allclose(np.cov(h.T, bias=True), covariance, rtol=0.15)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_median_bandwidth_puts_half_at_the_median_distance_on_every_scale(scale):
    h = scale * jnp.array([[0.3, -1.0], [2.0, 0.5]])
    velocity, kernel = stein_velocity(h, jnp.zeros_like(h), "median")
    assert kernel == pytest.approx(0.5)
    # with K = 1/2 and s^2 = |h_1 - h_2|^2 / (2 log 2), particle 1 is pushed along h_1 - h_2
    difference = h[0] - h[1]
    expected = 0.5 * difference / (jnp.sum(difference**2) / (2 * np.log(2))) / 2
    np.testing.assert_allclose(velocity[0], expected, rtol=1e-6)


def test_median_bandwidth_of_one_particle_follows_its_score():
    velocity, _ = stein_velocity(jnp.array([[0.3, -1.0]]), jnp.array([[1.0, 2.0]]), "median")
    np.testing.assert_allclose(velocity, [[1.0, 2.0]])


@pytest.mark.parametrize(("size", "m"), [(3, 5), (4, 4), (1, 7), (8, 20)])
def test_distinct_rows_are_distinct_and_uniform(size: int, m: int) -> None:
    keys = jax.random.split(jax.random.key(0), 4000)
    rows, counts = jax.vmap(lambda key: distinct_rows(key, size, jnp.asarray(m)))(keys)
    rows = np.asarray(rows)
    assert np.all(counts)
    assert all(len(set(row)) == size for row in rows)
    frequency = np.bincount(rows.ravel(), minlength=m) / len(rows)
    assert frequency.shape == (m,)  # none beyond the last
    np.testing.assert_allclose(frequency, size / m, atol=0.035)  # 4 standard errors of a fraction
    together = np.mean([(0 in row) and (m - 1 in row) for row in rows])
    np.testing.assert_allclose(together, size * (size - 1) / (m * (m - 1)), atol=0.035)


def test_of_too_few_rows_each_counts_once() -> None:
    rows, counts = distinct_rows(jax.random.key(0), 5, jnp.asarray(3))
    assert np.asarray(rows)[np.asarray(counts)].tolist() == [0, 1, 2]


@pytest.mark.parametrize("bandwidth", ["median", 2.0])
def test_particles_that_are_alike_move_alike(bandwidth: Any) -> None:
    from simpel_cli.methods.repulsive import Repulsive

    h = jnp.full((4, 3), 0.1)
    for velocity, near in (stein_velocity(h, -h, bandwidth), Repulsive(bandwidth=bandwidth).velocity(h, -h)):
        assert near == 1
        np.testing.assert_allclose(velocity, -h, rtol=1e-5)
