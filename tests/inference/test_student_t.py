"""Student's t noise against scipy and against numerical integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from simpel_cli.inference import student_t
from simpel_cli.inference.predictive import Predictive

TAILS = np.array([0.02, 0.1, 0.25, 0.45])
PARTICLES = np.array([[[0.0, 1.0]], [[0.7, -2.0]], [[0.3, 0.5]]])  # (L, n, dy)
SCALE, TAIL = np.array([0.4, 1.5]), np.array([0.25, 0.4])
Y = np.array([[1.1, 6.0]])
P = Predictive(jnp.asarray(PARTICLES), jnp.asarray(SCALE), jnp.asarray(TAIL))


def mixture(i: int) -> list:
    return [stats.t(1 / TAIL[i], loc=p, scale=SCALE[i]) for p in PARTICLES[:, 0, i]]


@pytest.mark.parametrize("tail", TAILS)
def test_density_and_distribution_are_scipys(tail: float) -> None:
    z = np.linspace(-30, 30, 61)
    at = jnp.asarray(tail)
    np.testing.assert_allclose(student_t.log_density(jnp.asarray(z), at), stats.t.logpdf(z, 1 / tail), rtol=1e-9)
    np.testing.assert_allclose(student_t.cdf(jnp.asarray(z), at), stats.t.cdf(z, 1 / tail), rtol=1e-7, atol=1e-12)


def test_the_table_of_the_distribution_is_scipys() -> None:
    z = np.concatenate([np.linspace(-40, 40, 4001), [-1e7, -1e4, 1e4, 1e7]])
    tails = np.asarray([0.01, *TAILS])
    found = student_t.cdf_of_outputs(jnp.asarray(np.tile(z[:, None], (1, len(tails)))), jnp.asarray(tails))
    for i, tail in enumerate(tails):
        np.testing.assert_allclose(found[:, i], stats.t.cdf(z, 1 / tail), rtol=0, atol=1e-8)


def test_draws_are_of_their_law() -> None:
    tails = np.asarray([0.05, *TAILS])
    drawn = np.asarray(student_t.draws(jax.random.key(0), (100, 200), jnp.asarray(tails)))
    assert drawn.shape == (100, 200, len(tails))
    for i, tail in enumerate(tails):
        assert stats.kstest(drawn[..., i].ravel(), stats.t(1 / tail).cdf).pvalue > 1e-3


@pytest.mark.parametrize("tail", TAILS)
def test_expected_distances_are_integrals(tail: float) -> None:
    law = stats.t(1 / tail)
    for mu in (0.0, 0.8, 12.0):
        whole, _ = quad(lambda e, mu=mu: abs(mu + e) * law.pdf(e), -np.inf, np.inf, points=None, limit=200)
        assert abs(float(student_t.expected_distance(jnp.asarray([mu]), jnp.asarray([tail]))[0]) / whole - 1) < 1e-6
    grid, table = student_t.distance_table(jnp.asarray([tail]))
    random = np.random.default_rng(0)
    apart = law.rvs(1_000_000, random_state=random) - law.rvs(1_000_000, random_state=random)
    for k in (0, 40, 70, 85):
        sample = np.abs(np.asarray(grid)[k] + apart)
        # of the heaviest tail a sample says little: its own standard error is the measure
        assert abs(table[0, k] - sample.mean()) < 5 * sample.std() / 1000 + 2e-3 * sample.mean()


def test_weights_and_information_are_those_of_the_law() -> None:
    tail, z = 0.2, 1.7
    drive = jax.grad(lambda z: student_t.log_density(z, jnp.asarray(tail)))(jnp.asarray(z))
    assert np.isclose(-drive, z * student_t.weight(jnp.asarray(z**2), jnp.asarray(tail)))
    of_location, of_scale = (float(v) for v in student_t.information(jnp.asarray(tail)))
    nodes = stats.t(1 / tail).ppf((np.arange(4000) + 0.5) / 4000)
    slopes = -np.asarray(jax.vmap(jax.grad(lambda z: student_t.log_density(z, jnp.asarray(tail))))(jnp.asarray(nodes)))
    assert np.isclose(np.mean(slopes**2), of_location, rtol=0.01)
    assert np.isclose(np.mean((slopes * nodes - 1) ** 2), of_scale, rtol=0.05)


def test_a_mixture_has_density_distribution_and_spread() -> None:
    density = np.mean([np.prod([mixture(i)[k].pdf(Y[0, i]) for i in range(2)]) for k in range(3)])
    np.testing.assert_allclose(P.log_prob(jnp.asarray(Y))[0], np.log(density), rtol=1e-9)
    for i in range(2):
        np.testing.assert_allclose(
            P.cdf(jnp.asarray(Y))[0, i], np.mean([m.cdf(Y[0, i]) for m in mixture(i)]), rtol=1e-8
        )
        variance = np.mean([m.var() for m in mixture(i)]) + PARTICLES[:, 0, i].var()
        np.testing.assert_allclose(P.std[0, i], np.sqrt(variance), rtol=1e-9)


def test_the_crps_is_the_integral_of_the_squared_distance() -> None:
    found = np.asarray(P.crps(jnp.asarray(Y)))[0]
    for i in range(2):

        def distribution(v: float, i: int = i) -> float:
            return float(np.mean([m.cdf(v) for m in mixture(i)]))

        left, _ = quad(lambda v, f=distribution: f(v) ** 2, -np.inf, Y[0, i], limit=200)
        right, _ = quad(lambda v, f=distribution: (1 - f(v)) ** 2, Y[0, i], np.inf, limit=200)
        assert abs(found[i] / (left + right) - 1) < 3e-3


def test_the_joint_region_of_heavy_tails_holds_what_it_says() -> None:
    """Draws of the mixture lie inside its 50 and 90 % regions as often as that; chi-squared would say 70 and 92 %."""
    n, random = 4000, np.random.default_rng(0)
    member = random.integers(0, 3, n)
    noise = np.stack([stats.t(1 / tail).rvs(n, random_state=random) for tail in TAIL], axis=1)
    y = PARTICLES[member, 0] + SCALE * noise
    many = Predictive(jnp.asarray(np.repeat(PARTICLES, n, axis=1)), P.noise_scale, P.tail)
    share = np.asarray(jax.jit(lambda y: many.share_within(y))(jnp.asarray(y)))
    for level in (0.5, 0.9):
        assert abs((share < level).mean() - level) < 0.03


def test_the_share_within_grows_with_the_distance() -> None:
    y = jnp.asarray(np.array([[0.33, -0.2], [3.0, 20.0]]))
    many = Predictive(jnp.asarray(np.repeat(PARTICLES, 2, axis=1)), P.noise_scale, P.tail)
    near, far = np.asarray(many.share_within(y))
    assert near < 0.1
    assert far > 0.95
