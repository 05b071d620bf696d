"""Scores of readings of a sensor that saturates, against draws that are clipped and against numerical integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from simpel_cli.evaluation.one_step import one_step
from simpel_cli.evaluation.posterior import Posterior
from simpel_cli.inference.predictive import Predictive

RNG = np.random.default_rng(0)
PARTICLES = RNG.normal(size=(5, 6, 2)) * [1.0, 2.0]
NOISE = np.array([0.5, 0.8])
LIMITS = np.array([[-0.8, 1.1], [-np.inf, 0.5]])
Y = np.array([[1.1, 0.5], [-0.8, -1.0], [0.2, 0.5], [1.1, 0.1], [-0.8, 0.5], [0.9, -3.0]])
TAILS = {"gaussian": None, "student_t": np.array([0.3, 0.1])}


def predictive(law: str, limits: np.ndarray | None = LIMITS) -> Predictive:
    tail = TAILS[law]
    return Predictive(jnp.asarray(PARTICLES), jnp.asarray(NOISE), None if tail is None else jnp.asarray(tail), limits)


def readings(law: str, draws: int = 400_000) -> np.ndarray:
    """Draws of what the sensors read, (draws, n, dy)."""
    rng, shape = np.random.default_rng(1), (draws, *Y.shape)
    tail = TAILS[law]
    noise = rng.normal(size=shape) if tail is None else rng.standard_t(np.broadcast_to(1 / tail, shape))
    centre = np.take_along_axis(PARTICLES, rng.integers(5, size=(draws, len(Y)))[:, :, None], axis=0)
    return np.clip(centre + NOISE * noise, LIMITS[:, 0], LIMITS[:, 1])


@pytest.mark.parametrize("law", TAILS)
def test_masses_densities_and_the_cdf_are_those_of_clipped_draws(law: str) -> None:
    p, drawn, y = predictive(law), readings(law), jnp.asarray(Y)
    at = (LIMITS[:, 0] == Y) | (LIMITS[:, 1] == Y)
    mass = np.mean(drawn == Y, axis=0)
    np.testing.assert_allclose(np.exp(np.asarray(p.log_prob_per_output(y)))[at], mass[at], atol=0.004)
    width = 0.1
    density = np.mean(np.abs(drawn - Y) < width / 2, axis=0) / width
    np.testing.assert_allclose(np.exp(np.asarray(p.log_prob_per_output(y)))[~at], density[~at], atol=0.02)
    np.testing.assert_allclose(p.cdf(y), np.mean(drawn <= Y, axis=0), atol=0.004)
    for end, share in zip(p.pit(y), (np.mean(drawn < Y, axis=0), np.mean(drawn <= Y, axis=0)), strict=True):
        np.testing.assert_allclose(end, share, atol=0.004)
    assert np.array_equal(p.cdf(y - 10)[:, 0], np.zeros(6))  # no reading lies below the low end
    assert (np.asarray(p.cdf(y - 10))[:, 1] > 0).any()


@pytest.mark.parametrize("law", TAILS)
def test_the_joint_density_keeps_the_outputs_of_a_particle_together(law: str) -> None:
    p = predictive(law)
    each = np.zeros((5, 6, 2))
    for i in range(2):
        tail = TAILS[law]
        one = norm if tail is None else student(1 / tail[i])
        z = (Y[:, i] - PARTICLES[:, :, i]) / NOISE[i]
        within = one.pdf(z) / NOISE[i]
        each[:, :, i] = np.where(
            Y[:, i] == LIMITS[i, 1], one.sf(z), np.where(Y[:, i] == LIMITS[i, 0], one.cdf(z), within)
        )
    np.testing.assert_allclose(p.log_prob(jnp.asarray(Y)), np.log(np.mean(np.prod(each, axis=-1), axis=0)), rtol=1e-9)


def integral(law: str, j: int, i: int) -> float:
    """CRPS of a reading by its definition, on a fine grid between the ends."""
    low, high = max(LIMITS[i, 0], -400.0), LIMITS[i, 1]
    t = np.concatenate([np.linspace(low, max(low, -12.0), 20_001), np.linspace(max(low, -12.0), high, 40_001)])
    tail = TAILS[law]
    one = norm if tail is None else student(1 / tail[i])
    below = np.mean(one.cdf((t[:, None] - PARTICLES[:, j, i]) / NOISE[i]), axis=1)
    return float(np.trapezoid((below - (t >= Y[j, i])) ** 2, t))


@pytest.mark.parametrize("law", TAILS)
def test_the_crps_is_the_integral_between_the_ends(law: str) -> None:
    found = predictive(law).crps(jnp.asarray(Y))
    exact = np.array([[integral(law, j, i) for i in range(2)] for j in range(6)])
    np.testing.assert_allclose(found, exact, rtol=0, atol=5e-4 * NOISE.min())
    plain = predictive(law, None).crps(jnp.asarray(Y))
    assert np.abs(np.asarray(plain) - exact).max() > 0.1


def test_one_particle_far_narrower_than_the_range() -> None:
    one = Predictive(jnp.zeros((20, 1, 1)), jnp.asarray([0.01]), None, np.array([[-10.0, 10.0]]))
    plain = one._replace(limits=None)
    for y in (0.0, 0.02, 3.0):
        at = jnp.asarray([[y]])
        np.testing.assert_allclose(one.crps(at), plain.crps(at), rtol=0, atol=5e-4 * 0.01)


@pytest.mark.parametrize("law", TAILS)
def test_without_ends_nothing_changes(law: str) -> None:
    plain, open_ = predictive(law, None), predictive(law, np.array([[-np.inf, np.inf]] * 2))
    y = jnp.asarray(Y)
    for of in (
        Predictive.log_prob,
        Predictive.crps,
        Predictive.cdf,
        Predictive.pit,
        Predictive.reading,
    ):
        np.testing.assert_array_equal(of(plain, y), of(open_, y))


def expected(p: Predictive, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What `one_step` makes of readings that have these probabilities: coverage of every output and of all together."""

    def predict(x: np.ndarray) -> Predictive:
        rows = np.asarray(x)[:, 0].astype(int)
        return p._replace(particles=jnp.asarray(np.asarray(p.particles)[:, np.zeros_like(rows)]))

    def members(x: np.ndarray) -> jax.Array:
        raise AssertionError("one step ahead nobody asks for single members")

    found = one_step(Posterior(predict, members, p.particles.shape[0]), np.arange(len(y), dtype=float)[:, None], y)
    assert np.sum(weight) == pytest.approx(1.0)
    return np.append(weight @ found.inside, [weight @ found.below[:, i] for i in (0, -1)])


@pytest.mark.parametrize("law", TAILS)
@pytest.mark.parametrize("high", [0.3, 1.0, 4.0])
def test_expected_coverage_is_the_nominal_one(law: str, high: float) -> None:
    """Over all readings by their probability: the mass at the end, and 400 equal shares of the law below it."""
    tail, centre, scale = TAILS[law], 0.2, 0.5
    one = norm if tail is None else student(1 / tail[0])
    below = one.cdf((high - centre) / scale)
    inner = centre + scale * one.ppf(below * (np.arange(400) + 0.5) / 400)
    y, weight = np.append(inner, high)[:, None], np.append(np.full(400, below / 400), 1 - below)
    p = Predictive(
        jnp.full((1, 1, 1), centre), jnp.asarray([scale]), None if tail is None else jnp.asarray(tail[:1]),
        np.array([[-np.inf, high]]),
    )  # fmt: skip
    nominal = np.concatenate([[0.9, 0.9], np.tile(np.arange(0.05, 0.951, 0.05), 2)])
    found = expected(p, y, weight)
    own = [0, *range(2, 21)]
    np.testing.assert_allclose(found[own], nominal[own], atol=0.003)
    # all together by 32 values of the mass, and where tails are heavy by 512 draws
    np.testing.assert_allclose(found, nominal, atol=1 / 64 if tail is None else 0.05)


@pytest.mark.parametrize("law", TAILS)
def test_the_joint_coverage_is_that_of_what_readings_hide(law: str) -> None:
    """Of draws of two particles and two outputs: the mean share is how often the quantity itself lies in the region."""
    rng, n, tail = np.random.default_rng(4), 3000, TAILS[law]
    limits = np.array([[-0.4, 0.9], [-np.inf, 0.5]])
    centres = np.array([[[-0.5, 0.0]], [[0.6, 1.0]]])
    noise = rng.normal(size=(n, 2)) if tail is None else rng.standard_t(1 / tail, size=(n, 2))
    true = centres[rng.integers(2, size=n), 0] + NOISE * noise
    p = Predictive(
        jnp.asarray(np.repeat(centres, n, axis=1)),
        jnp.asarray(NOISE),
        None if tail is None else jnp.asarray(tail),
        limits,
    )
    read = np.clip(true, limits[:, 0], limits[:, 1])
    assert np.mean((read != true).any(axis=1)) > 0.5
    levels = jnp.asarray([0.3, 0.6, 0.9])
    known = np.asarray(p._replace(limits=None).within(jnp.asarray(true), levels)).mean(axis=0)
    found = np.asarray(jax.jit(Predictive.within)(p, jnp.asarray(read), levels))
    np.testing.assert_allclose(found.mean(axis=0), known, atol=0.02)
    assert ((found > 0.02) & (found < 0.98)).any()


@pytest.mark.parametrize("law", TAILS)
def test_a_right_predictive_covers_what_it_says(law: str) -> None:
    """Readings of a Gaussian whose ends cut off 40 %: coverage, calibration, and errors of the reading."""
    n, tail = 1024, TAILS[law]
    rng = np.random.default_rng(2)
    centre = rng.normal(size=(n, 1))
    noise = rng.normal(size=(n, 1)) if tail is None else rng.standard_t(1 / tail[0], size=(n, 1))
    limits = np.array([[-0.7, 1.0]])
    y = np.clip(centre + 0.5 * noise, *limits[0])
    x = np.arange(n, dtype=float)[:, None]

    def predict(x: np.ndarray) -> Predictive:
        rows = np.asarray(x)[:, 0].astype(int)
        h = jnp.asarray(centre[rows][None])
        return Predictive(h, jnp.asarray([0.5]), None if tail is None else jnp.asarray(tail[:1]), limits)

    def members(x: np.ndarray) -> jax.Array:
        raise AssertionError("one step ahead nobody asks for single members")

    found = one_step(Posterior(predict, members, 1), x, y)
    assert np.isfinite(found.nll).all()
    assert found.inside[:, 0].mean() == pytest.approx(0.9, abs=0.03)
    assert found.inside[:, 1].mean() == pytest.approx(0.9, abs=0.03)
    np.testing.assert_allclose(found.squared[:, 0], (y - np.clip(centre, *limits[0]))[:, 0] ** 2)
    np.testing.assert_allclose(found.mean, centre)
    draws = np.clip(
        centre + 0.5 * (rng.normal(size=(n, 200)) if tail is None else rng.standard_t(1 / tail[0], (n, 200))),
        *limits[0],
    )
    crps = np.mean(np.abs(draws - y), axis=1) - 0.5 * np.mean(np.abs(draws[:, :100] - draws[:, 100:]), axis=1)
    assert found.crps[:, 0].mean() == pytest.approx(crps.mean(), abs=0.006)
