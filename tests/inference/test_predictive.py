"""The mixture of particles against scipy."""

import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from scipy.stats import multivariate_normal, norm

from simpel_cli.inference.predictive import Predictive

RNG = np.random.default_rng(0)
PARTICLES = RNG.normal(size=(6, 4, 2)) * [1.0, 5.0] + [0.0, 3.0]
NOISE = np.array([0.3, 0.8])
Y = RNG.normal(size=(4, 2)) * [1.0, 5.0] + [0.0, 3.0]
P = Predictive(jnp.asarray(PARTICLES), jnp.asarray(NOISE))
PLACES = [(j, i) for j in range(4) for i in range(2)]


def test_joint_density_keeps_the_outputs_of_a_particle_together() -> None:
    for j in range(4):
        densities = [multivariate_normal.pdf(Y[j], PARTICLES[k, j], np.diag(NOISE**2)) for k in range(6)]
        np.testing.assert_allclose(P.log_prob(jnp.asarray(Y))[j], np.log(np.mean(densities)), rtol=1e-10)


@pytest.mark.parametrize(("j", "i"), PLACES)
def test_density_of_an_output(j: int, i: int) -> None:
    expected = oracles.mixture_log_density(Y[j, i], PARTICLES[:, j, i], NOISE[i])
    np.testing.assert_allclose(P.log_prob_per_output(jnp.asarray(Y))[j, i], expected, rtol=1e-10)


def test_density_far_away_does_not_underflow() -> None:
    far = P.log_prob(jnp.asarray(Y + 1e3))
    nearest = np.max(np.sum(-0.5 * ((Y + 1e3 - PARTICLES) / NOISE) ** 2, axis=-1), axis=0)
    np.testing.assert_allclose(far, nearest, rtol=1e-3)


@pytest.mark.parametrize(("j", "i"), PLACES)
def test_cdf(j: int, i: int) -> None:
    expected = norm.cdf(Y[j, i], PARTICLES[:, j, i], NOISE[i]).mean()
    np.testing.assert_allclose(P.cdf(jnp.asarray(Y))[j, i], expected, rtol=1e-10)


@pytest.mark.parametrize(("j", "i"), PLACES)
def test_crps_is_its_integral(j: int, i: int) -> None:
    expected = oracles.mixture_crps(Y[j, i], PARTICLES[:, j, i], NOISE[i])
    np.testing.assert_allclose(P.crps(jnp.asarray(Y))[j, i], expected, rtol=1e-6)


def test_crps_of_one_gaussian() -> None:
    """Gneiting and Raftery (2007), eq. 21."""
    z = (Y[0, 0] - PARTICLES[0, 0, 0]) / NOISE[0]
    expected = NOISE[0] * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - np.pi**-0.5)
    one = Predictive(jnp.asarray(PARTICLES[:1]), jnp.asarray(NOISE))
    np.testing.assert_allclose(one.crps(jnp.asarray(Y))[0, 0], expected, rtol=1e-10)


def test_moments_and_their_parts() -> None:
    np.testing.assert_allclose(P.mean, PARTICLES.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(P.epistemic_std, PARTICLES.std(axis=0), rtol=1e-12)
    np.testing.assert_allclose(P.std**2, PARTICLES.std(axis=0) ** 2 + NOISE**2, rtol=1e-12)
    rng = np.random.default_rng(1)
    samples = PARTICLES[rng.integers(6, size=100_000), 2] + NOISE * rng.normal(size=(100_000, 2))
    np.testing.assert_allclose(P.std[2], samples.std(axis=0), rtol=0.02)


def test_mahalanobis_distance() -> None:
    for j in range(4):
        covariance = np.cov(PARTICLES[:, j].T, bias=True) + np.diag(NOISE**2)
        off = Y[j] - PARTICLES[:, j].mean(axis=0)
        np.testing.assert_allclose(P.mahalanobis(jnp.asarray(Y))[j], off @ np.linalg.solve(covariance, off), rtol=1e-10)
