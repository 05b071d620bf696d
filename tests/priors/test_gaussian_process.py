"""Kernels against their formulas, the exact posterior against an independent one, the gap's scale against the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from simpel_cli.priors.gap_scale import marginal_likelihood_scales
from simpel_cli.priors.gaussian_process import Kernel, Matern32, Matern52, Spectral, SquaredExponential, gram, posterior

# Rasmussen and Williams (2006), eqs. 4.9 and 4.17, as functions of the distance r in lengthscales
FORMULAS = [
    (SquaredExponential(), lambda r: np.exp(-(r**2) / 2)),
    (Matern32(), lambda r: (1 + 3**0.5 * r) * np.exp(-(3**0.5) * r)),
    (Matern52(), lambda r: (1 + 5**0.5 * r + 5 * r**2 / 3) * np.exp(-(5**0.5) * r)),
]
KERNELS = [kernel for kernel, _ in FORMULAS]


@pytest.mark.parametrize(("kernel", "formula"), FORMULAS)
def test_correlation(kernel: Kernel, formula: object) -> None:
    r = np.array([0.0, 1e-3, 0.3, 1.0, 2.5, 9.0])
    np.testing.assert_allclose(kernel.correlation(jnp.asarray(r**2)), formula(r), rtol=1e-14)  # type: ignore[operator]


@pytest.mark.parametrize("kernel", KERNELS)
def test_gram_is_a_correlation_matrix(kernel: Kernel) -> None:
    x = np.random.default_rng(0).normal(size=(30, 3))
    x[7] = x[3]
    k = np.asarray(gram(kernel, jnp.asarray(x), jnp.asarray(x)))
    np.testing.assert_allclose(k, k.T, rtol=1e-15)
    np.testing.assert_array_equal(np.diag(k), 1)
    assert np.linalg.eigvalsh(k).min() > -1e-12
    r2 = np.sum((x[4] - x[9]) ** 2)  # the distance is Euclidean over all coordinates
    np.testing.assert_allclose(k[4, 9], kernel.correlation(jnp.asarray(r2)), rtol=1e-14)


@pytest.mark.parametrize("kernel", KERNELS)
def test_gradient_vanishes_where_points_coincide(kernel: Kernel) -> None:
    x = jnp.zeros((2, 2))
    slope = jax.grad(lambda a: jnp.sum(gram(kernel, a, x)))(x)
    np.testing.assert_array_equal(slope, 0)
    away = jax.grad(lambda a: jnp.sum(gram(kernel, a, x)))(x + 0.1)
    assert np.all(away < -1e-3)  # the correlation falls with distance


@pytest.mark.parametrize("kernel", KERNELS)
def test_frequencies_are_those_of_the_kernel(kernel: Spectral) -> None:
    """Bochner: rho(r) is the mean of cos(w r)."""
    w = np.asarray(kernel.frequencies(jax.random.key(0), 200_000, 3))
    for r in (0.1, 0.7, 2.0):
        apart = np.array([0.6, -0.8, 0.0]) * r
        np.testing.assert_allclose(np.cos(w @ apart).mean(), kernel.correlation(jnp.asarray(r**2)), atol=0.006)


def test_posterior() -> None:
    rng = np.random.default_rng(1)
    x, grid, y = np.sort(rng.uniform(-2, 2, 7)), np.linspace(-3, 3, 11), rng.normal(size=7)
    kk, kx, k = (1.7**2 * oracles.squared_exponential(a, b, 0.8) for a, b in ((grid, grid), (grid, x), (x, x)))
    mean, covariance = posterior(*map(jnp.asarray, (k, kx, kk, y)), 0.05)
    expected, spread = oracles.gp_posterior(k, kx, kk, y, 0.05**0.5)
    np.testing.assert_allclose(mean, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(covariance, spread, rtol=1e-9, atol=1e-12)


def test_posterior_interpolates_without_noise_and_returns_to_the_prior_far_away() -> None:
    x, y = np.array([-1.0, 0.0, 1.5]), np.array([0.3, -2.0, 1.0])
    grid = np.append(x, 50.0)
    k = [jnp.asarray(oracles.squared_exponential(a, b, 1.0)) for a, b in ((x, x), (grid, x), (grid, grid))]
    mean, covariance = posterior(*k, jnp.asarray(y), 1e-10)
    np.testing.assert_allclose(mean, [*y, 0], atol=1e-8)
    np.testing.assert_allclose(np.diag(covariance), [0, 0, 0, 1], atol=1e-8)


def scales(kappa: float, seeds: int, m: int = 60, noise: float = 0.1) -> list[float]:
    """Estimates of kappa from data that the model itself made: linear simulator + gap + noise."""
    chosen = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-3, 3, m)
        correlation = oracles.squared_exponential(x, x, 1.0)
        slopes = rng.normal(1, 0.3, 513)
        gap = kappa * np.linalg.cholesky(correlation + 1e-9 * np.eye(m)) @ rng.normal(size=m)
        y = slopes[0] * x + gap + noise * rng.normal(size=m)
        chosen.append(marginal_likelihood_scales(slopes[1:, None] * x, correlation, y, 0.2, 1e-4).gap)
    return chosen


@pytest.mark.parametrize("kappa", [0.1, 0.5, 2.0])
def test_marginal_likelihood_recovers_the_scale_of_the_gap(kappa: float) -> None:
    chosen = np.log(scales(kappa, 12))
    # about 6 independent values of a gap over 6 lengthscales: standard error of log kappa about 0.3 each
    assert abs(chosen.mean() - np.log(kappa)) < 0.3
    assert abs(chosen - np.log(kappa)).max() < 1.1


def test_marginal_likelihood_finds_no_gap_where_there_is_none() -> None:
    chosen = np.array(scales(0.0, 12))
    assert np.median(chosen) < 0.03
    assert chosen.max() < 0.12  # of the order of the noise, 0.1, at the worst


def test_marginal_likelihood_recovers_the_noise_beside_a_gap_that_is_known() -> None:
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-3, 3, 60)
        correlation = oracles.squared_exponential(x, x, 1.0)
        gap = 0.5 * np.linalg.cholesky(correlation + 1e-9 * np.eye(60)) @ rng.normal(size=60)
        y = gap + 0.1 * rng.normal(size=60)
        scales = marginal_likelihood_scales(np.zeros((2, 60)), correlation, y, 0.3, 1e-6, 0.5)
        assert scales.gap == 0.5
        found.append(np.log(scales.noise))
    # 54 values that the gap cannot follow: standard error of log sigma 0.1 each
    assert abs(np.mean(found) - np.log(0.1)) < 0.1
    assert abs(np.array(found) - np.log(0.1)).max() < 0.4


def test_what_a_gap_that_is_known_to_be_none_leaves_is_noise() -> None:
    x = np.linspace(-3, 3, 60)
    wave = 0.3 * np.sin(x)
    scales = marginal_likelihood_scales(np.zeros((2, 60)), oracles.squared_exponential(x, x, 1.0), wave, 0.3, 1e-6, 0.0)
    assert scales.gap == 0.0
    assert scales.noise == pytest.approx(wave.std(), rel=0.05)


def test_where_data_are_few_the_scale_stays_with_its_prior() -> None:
    one = marginal_likelihood_scales(np.zeros((8, 1)), np.eye(1), np.array([0.1]), 0.1, 1e-4).gap
    assert 0.03 < one < 0.3
