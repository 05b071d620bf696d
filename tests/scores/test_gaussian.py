"""The moment-matched Gaussian score against exact scores."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from simpel_cli.errors import ConfigError
from simpel_cli.scores.gaussian import Gaussian, _ledoit_wolf

RNG = np.random.default_rng(0)
M = 5
ROOT = RNG.normal(size=(M, M)) / M**0.5 + np.eye(M)
COVARIANCE, MEAN = ROOT @ ROOT.T, np.array([1.0, -2.0, 0.5, 3.0, 0.0])
H = RNG.normal(size=(7, M)) * 2
NOTHING = jnp.zeros((M, M))


def draws(n: int, seed: int = 1) -> np.ndarray:
    return MEAN + np.random.default_rng(seed).normal(size=(n, M)) @ ROOT.T


def relative_error(score: jax.Array, exact: np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(score) - exact) / np.linalg.norm(exact))


EXACT = oracles.gaussian_score(H, MEAN, COVARIANCE)


def test_exact_for_a_gaussian_in_the_limit_at_the_rate_of_monte_carlo() -> None:
    sizes = np.array([100, 1000, 10_000, 100_000])
    errors = [
        np.mean(
            [
                relative_error(Gaussian()(jnp.asarray(H), jnp.asarray(draws(int(n), s)), NOTHING), EXACT)
                for s in range(5)
            ]
        )
        for n in sizes
    ]
    assert errors[-1] < 0.02
    rate = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(rate + 0.5) < 0.08


def test_uses_the_unbiased_moments_of_the_draws() -> None:
    samples = draws(20)
    expected = oracles.gaussian_score(H, samples.mean(axis=0), np.cov(samples, rowvar=False))
    np.testing.assert_allclose(Gaussian()(jnp.asarray(H), jnp.asarray(samples), NOTHING), expected, rtol=1e-9)


def test_known_covariance_is_added_in_closed_form() -> None:
    gap = 0.3 * np.exp(-np.abs(np.subtract.outer(np.arange(M), np.arange(M))) / 2)
    samples = draws(200_000)
    closed = Gaussian()(jnp.asarray(H), jnp.asarray(samples), jnp.asarray(gap))
    sampled = samples + np.random.default_rng(5).normal(size=samples.shape) @ np.linalg.cholesky(gap).T
    by_draws = Gaussian()(jnp.asarray(H), jnp.asarray(sampled), NOTHING)
    exact = oracles.gaussian_score(H, MEAN, COVARIANCE + gap)
    assert relative_error(closed, exact) < 0.01
    assert relative_error(by_draws, exact) < 0.01
    assert relative_error(closed, EXACT) > 0.2  # the gap matters here


def test_without_sampled_part_it_is_exact() -> None:
    score = Gaussian()(jnp.asarray(H), jnp.zeros((2, M)), jnp.asarray(COVARIANCE))
    np.testing.assert_allclose(score, oracles.gaussian_score(H, np.zeros(M), COVARIANCE), rtol=1e-10)


def test_affine_equivariance() -> None:
    """Under h -> A h + b the score goes over into A^-T score."""
    a, b = np.random.default_rng(3).normal(size=(M, M)), np.arange(M)
    samples, gap = draws(50), 0.1 * np.eye(M)
    before = Gaussian()(jnp.asarray(H), jnp.asarray(samples), jnp.asarray(gap))
    after = Gaussian()(jnp.asarray(H @ a.T + b), jnp.asarray(samples @ a.T + b), jnp.asarray(a @ gap @ a.T))
    np.testing.assert_allclose(after, np.linalg.solve(a.T, before.T).T, rtol=1e-8)


def test_float32_in_float32_out_though_the_covariance_is_nearly_singular() -> None:
    # draws of a simulator with one parameter: rank one
    slopes = np.random.default_rng(4).normal(1, 0.3, 1028)
    x = np.linspace(-1, 1, 40)
    samples, h = slopes[:, None] * x, 0.7 * x[None]
    score = Gaussian()(
        jnp.asarray(h, jnp.float32), jnp.asarray(samples, jnp.float32), 1e-4 * jnp.eye(40, dtype=jnp.float32)
    )
    exact = oracles.gaussian_score(h, samples.mean(axis=0), np.cov(samples, rowvar=False) + 1e-4 * np.eye(40))
    assert score.dtype == jnp.float32
    assert relative_error(score, exact) < 1e-2


def weight_of(samples: np.ndarray) -> float:
    """The weight that the package used, read off an off-diagonal element."""
    centred, s = samples - samples.mean(axis=0), np.cov(samples, rowvar=False)
    shrunk = np.asarray(_ledoit_wolf(jnp.asarray(centred), jnp.asarray(s)))
    np.testing.assert_allclose(np.trace(shrunk), np.trace(s), rtol=1e-12)  # the mean eigenvalue stays
    return float(1 - shrunk[0, 1] / s[0, 1])


@pytest.mark.parametrize("n", [4, 12, 100])
def test_ledoit_wolf_weight(n: int) -> None:
    np.testing.assert_allclose(weight_of(draws(n)), oracles.ledoit_wolf_weight(draws(n)), rtol=1e-9)


def test_ledoit_wolf_weight_approaches_the_optimum() -> None:
    """For Gaussian draws E|S - Sigma|^2 = (tr Sigma^2 + (tr Sigma)^2)/(n - 1), so the best weight is known."""
    distance = np.sum((COVARIANCE - np.trace(COVARIANCE) / M * np.eye(M)) ** 2)
    for n in (200, 4000):
        error = (np.trace(COVARIANCE @ COVARIANCE) + np.trace(COVARIANCE) ** 2) / (n - 1)
        mean = np.mean([weight_of(draws(n, s)) for s in range(20)])
        np.testing.assert_allclose(mean, error / (error + distance), rtol=0.15)
    assert mean < 0.005  # much data is left alone


def test_ledoit_wolf_is_better_than_nothing_in_many_dimensions() -> None:
    m, n = 40, 60
    samples, h = np.random.default_rng(6).normal(size=(n, m)), np.random.default_rng(7).normal(size=(5, m))
    errors = {
        s: relative_error(Gaussian(s)(jnp.asarray(h), jnp.asarray(samples), 1e-6 * jnp.eye(m)), -h)
        for s in ("none", "ledoit_wolf")
    }
    assert errors["ledoit_wolf"] < 0.3 < 1 < errors["none"]


def test_unknown_shrinkage_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"score.shrinkage: got 'lw'; allowed are none and ledoit_wolf"):
        Gaussian("lw")
