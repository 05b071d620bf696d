"""Rules along the axes of the posterior against Gaussian posteriors whose outputs differ by a factor of a thousand."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.methods.fmap import FunctionMAP
from simpel_cli.methods.fsvgd import FSVGD, kernel_between, newton_velocity, stein_velocity
from simpel_cli.methods.posterior_axes import Axes, axes_of, basis
from simpel_cli.methods.repulsive import Repulsive

SCALES = np.array([1.0, 1e3])  # of the two outputs
RULE = FSVGD(precondition=True)


class Exact(NamedTuple):
    """A Gaussian posterior at k points, every point measured, per output.

    Args:
        mean: (k, 2).
        covariance: (2, k, k).
        prior: covariance, (2, k, k).
        noise: variance, (2,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    prior: np.ndarray
    noise: np.ndarray

    def score(self, h: jax.Array) -> jax.Array:
        precision = jnp.asarray(np.linalg.inv(self.covariance))
        return jnp.einsum("dij,ljd->lid", precision, jnp.asarray(self.mean)[None] - h)

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.einsum("dii->id", self.covariance))


def exact_of(points: int, weight: float = 1.0) -> Exact:
    """A smooth prior of unequal outputs, and noise of a third of its standard deviation."""
    x = np.linspace(0, 3, points)
    prior = np.exp(-0.5 * (x[:, None] - x[None]) ** 2) + 1e-6 * np.eye(points)
    prior, noise = prior[None] * SCALES[:, None, None] ** 2, 0.1 * SCALES**2
    precision = weight * np.linalg.inv(prior) + np.eye(points) / noise[:, None, None]
    return Exact(np.sin(x)[:, None] * SCALES, np.linalg.inv(precision), prior, noise)


def axes(exact: Exact, weight: float = 1.0) -> Axes:
    own = basis(jnp.asarray(exact.prior), jnp.dtype(jnp.float64))
    return axes_of(own, jnp.asarray(exact.noise), weight)


def flown(rule: Any, exact: Exact, particles: int, steps: int) -> np.ndarray:
    """Particles, from far off, after steps of a fifth of the velocity."""
    own = axes(exact)
    begin = 3 * SCALES * np.random.default_rng(0).normal(size=(particles, *exact.mean.shape))

    def body(_: Any, h: jax.Array) -> jax.Array:
        return h + 0.2 * own.moved(rule.velocity, h, exact.score(h))[0]

    return np.asarray(jax.jit(lambda h: jax.lax.fori_loop(0, steps, body, h))(jnp.asarray(begin)))


@pytest.mark.parametrize(("particles", "points", "bar"), [(5, 2, 0.1), (20, 12, 0.02), (80, 12, 0.02), (80, 40, 0.02)])
def test_particles_have_the_mean_spread_and_correlations_of_the_posterior_on_every_scale(
    particles: int, points: int, bar: float
) -> None:
    """Within 200 steps. Five particles span four directions, so that they can fill no more than a few points."""
    exact = exact_of(points)
    h = flown(RULE, exact, particles, 200)
    np.testing.assert_allclose((h.mean(axis=0) - exact.mean) / exact.std, 0, atol=0.02)
    np.testing.assert_allclose(h.std(axis=0) / exact.std, 1, atol=bar)
    for i in range(2):
        found, true = np.corrcoef(h[:, :, i].T), exact.covariance[i] / np.outer(exact.std[:, i], exact.std[:, i])
        np.testing.assert_allclose(found, true, atol=bar)


def test_steins_own_velocity_is_not_there_by_then() -> None:
    """The same particles at rest, but what sets them apart takes many times as long."""

    class Plain(FSVGD):
        def velocity(self, h: Any, score: Any) -> Any:
            return stein_velocity(h, score, self.bandwidth)

    exact = exact_of(12)
    slow, late = (flown(Plain(precondition=True), exact, 20, steps) for steps in (200, 6000))
    assert np.max(slow.std(axis=0) / exact.std) > 1.5
    np.testing.assert_allclose(late.std(axis=0) / exact.std, 1, atol=0.02)


@pytest.mark.parametrize("bandwidth", [2.0, "median"])
def test_newtons_velocity_is_that_of_stein_without_the_kernel_in_front(bandwidth: float | str) -> None:
    """(K + 0.01 I) v = L phi: both are zero for the same particles."""
    rng = np.random.default_rng(0)
    h, score = jnp.asarray(rng.normal(size=(6, 4))), jnp.asarray(rng.normal(size=(6, 4)))
    kernel, _ = kernel_between(h, bandwidth)
    found, near = newton_velocity(h, score, bandwidth)
    plain, same = stein_velocity(h, score, bandwidth)
    np.testing.assert_allclose((kernel + 0.01 * jnp.eye(6)) @ found, 6 * plain, rtol=1e-9)
    assert near == same


def test_one_particle_climbs_to_the_mode() -> None:
    h = jnp.zeros((1, 3))
    np.testing.assert_allclose(newton_velocity(h, h + 2.0, 2.0)[0], 2.0 / 1.01)


@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_a_particle_on_its_own_takes_newtons_step(weight: float) -> None:
    """v = P s, also along directions that are held in the kernel: there P has 1e-6 of its largest eigenvalue."""
    exact = exact_of(8, weight)
    h = jnp.asarray(np.random.default_rng(1).normal(size=(3, 8, 2)) * SCALES)
    found, _ = axes(exact, weight).moved(FunctionMAP().velocity, h, exact.score(h))
    np.testing.assert_allclose(found, jnp.asarray(exact.mean)[None] - h, rtol=1e-6, atol=1e-6 * SCALES[1])


@pytest.mark.parametrize("rule", [RULE, Repulsive(precondition=True), FSVGD(precondition=True, bandwidth="median")])
def test_units_and_axes_of_function_values_do_not_matter(rule: Any) -> None:
    """Values are turned and stretched, A h, so that the score is A^-T s: the velocity is A v."""
    rng = np.random.default_rng(2)
    # eigenvalues within a factor of four: none is held, also after A
    prior = np.stack([np.diag(rng.uniform(1, 4, 5)) for _ in range(2)])
    turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    stretch = np.array([3.0, 0.2])
    h, s = rng.normal(size=(7, 5, 2)), rng.normal(size=(7, 5, 2))

    def moved(covariance: np.ndarray, noise: np.ndarray, h: np.ndarray, s: np.ndarray) -> np.ndarray:
        own = axes_of(basis(jnp.asarray(covariance), jnp.dtype(jnp.float64)), jnp.asarray(noise))
        return np.asarray(own.moved(rule.velocity, jnp.asarray(h), jnp.asarray(s))[0])

    plain = moved(prior, np.ones(2), h, s)
    turned = moved(
        stretch[:, None, None] ** 2 * (turn @ prior @ turn.T), stretch**2,
        np.einsum("ij,ljd->lid", turn, h) * stretch, np.einsum("ij,ljd->lid", turn, s) / stretch,
    )  # fmt: skip
    np.testing.assert_allclose(turned, np.einsum("ij,ljd->lid", turn, plain) * stretch, rtol=1e-9, atol=1e-12)


def test_an_output_that_the_prior_knows_does_not_move() -> None:
    own = axes_of(basis(jnp.asarray(np.stack([np.eye(3), np.zeros((3, 3))])), jnp.dtype(jnp.float64)), jnp.ones(2))
    h = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3, 2)))
    found, near = own.moved(RULE.velocity, h, -h)
    assert np.isfinite(near)
    assert np.abs(found[..., 0]).min() > 0
    np.testing.assert_array_equal(found[..., 1], 0)
