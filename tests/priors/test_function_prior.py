"""Functional priors: parameter draws, the simulator part, the covariance of the Gaussian part."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from systems import model

from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simpel_cli.priors.function_prior import (
    GapGP,
    GPPrior,
    SimulatorPrior,
    followed,
    instead_of_lost,
    sample_parameters,
)
from simpel_cli.priors.gaussian_process import Matern32
from simulators.model import Quantity

N = 40_000
PARAMS = (
    Quantity("a", "", 1.0, 4.0),
    Quantity("b", "", -3.0, 1.0, prior="normal"),
    Quantity("c", "", 0.1, 10.0, prior="lognormal"),
    Quantity("d", "", -1.0, 1.0),
)


@pytest.fixture(scope="module")
def phi() -> np.ndarray:
    return np.asarray(sample_parameters(jax.random.key(0), PARAMS, N, jnp.dtype("float64")))


@pytest.mark.parametrize(
    ("column", "mean", "std"),
    [(0, 2.5, 3 / 12**0.5), (1, -1.0, 1.0), (2, 0.0, np.log(100) / 4), (3, 0.0, 2 / 12**0.5)],
)
def test_parameters_have_the_declared_moments(phi: np.ndarray, column: int, mean: float, std: float) -> None:
    draws = np.log(phi[:, column]) if PARAMS[column].prior == "lognormal" else phi[:, column]
    assert abs(draws.mean() - mean) < 4 * std / N**0.5
    assert abs(draws.std() - std) < 4 * std / (2 * N) ** 0.5


def test_uniform_stays_in_its_range_and_a_normal_leaves_it_one_time_in_22(phi: np.ndarray) -> None:
    for column in (0, 3):
        quantity = PARAMS[column]
        assert quantity.low <= phi[:, column].min() < quantity.low + 1e-3
        assert quantity.high - 1e-3 < phi[:, column].max() <= quantity.high
    for column in (1, 2):
        outside = np.mean((phi[:, column] < PARAMS[column].low) | (phi[:, column] > PARAMS[column].high))
        assert abs(outside - 0.0455) < 4 * (0.0455 / N) ** 0.5
    assert np.abs(np.corrcoef(phi.T) - np.eye(4))[:2, :2].max() < 4.5 / N**0.5


def test_simulator_part_is_the_one_step_map_of_every_draw_at_every_input() -> None:
    m = model("pendulum")
    bound = transition(m, encoding_of(m))
    prior = SimulatorPrior().bind(bound, 4, 3, np.ones(4))
    x = jnp.array([[0.0, 1.0, 1.2, 0.5], [0.6, 0.8, -3.0, -1.0]])
    key = jax.random.key(3)
    draws = prior.simulate(key, x, 5)
    phi = sample_parameters(key, m.params, 5, x.dtype)
    assert draws.shape == (5, 2, 3)
    for i in range(5):
        for j in range(2):
            np.testing.assert_allclose(draws[i, j], bound.step(x[j], phi[i]), rtol=1e-12, atol=1e-14)
    assert np.ptp(draws[:, 1, 2]) > 0.01  # draws differ
    np.testing.assert_array_equal(draws, prior.simulate(key, x, 5))
    assert np.any(draws != prior.simulate(jax.random.key(4), x, 5))


def test_draws_that_ran_away_are_replaced_whole_and_the_others_stay() -> None:
    draws = jnp.arange(24.0).reshape(6, 2, 2)
    draws = draws.at[1, 0, 1].set(jnp.nan).at[2, 1, 0].set(-jnp.inf).at[4, 0, 0].set(300.0)
    reach = np.array([100.0, np.inf])
    np.testing.assert_array_equal(followed(draws, reach), [True, False, False, True, False, True])
    kept = instead_of_lost(draws, reach)
    np.testing.assert_array_equal(kept[np.array([0, 3, 5])], draws[np.array([0, 3, 5])])
    np.testing.assert_array_equal(kept[np.array([1, 2, 4])], draws[np.array([3, 5, 3])])  # one after the other
    lost = jnp.full((3, 1, 2), jnp.nan)
    assert np.isnan(instead_of_lost(lost, reach)).all()  # nothing to put there


def test_covariance_of_the_gap() -> None:
    x_std = np.array([2.0, 0.5])
    prior = SimulatorPrior(GapGP(lengthscale=1.5), white_variance=1e-3).bind(None, 2, 3, x_std)
    x = np.random.default_rng(0).normal(size=(4, 2))
    kappa = np.array([0.5, 2.0, 0.0])
    c = np.asarray(prior.covariance(jnp.asarray(x), kappa))
    r2 = np.sum((x[:, None] - x[None]) ** 2, axis=-1)
    for i in range(3):
        np.testing.assert_allclose(c[i], kappa[i] ** 2 * np.exp(-r2 / 1.5**2 / 2) + 1e-3 * np.eye(4), rtol=1e-12)


def test_lengthscale_in_data_units_and_by_default() -> None:
    x_std = np.array([2.0, 0.5])
    x = jnp.asarray([[0.0, 0.0], [1.0, 0.3]])
    raw = SimulatorPrior(GapGP(lengthscale=1.5, lengthscale_units="raw")).bind(None, 2, 1, x_std)
    r2 = ((1.0 * 2.0) ** 2 + (0.3 * 0.5) ** 2) / 1.5**2
    np.testing.assert_allclose(raw.covariance(x, np.ones(1))[0, 0, 1], np.exp(-r2 / 2), rtol=1e-12)
    default = SimulatorPrior().bind(None, 2, 1, x_std)
    r2 = (1.0**2 + 0.3**2) / (2 * 2**0.5) ** 2
    np.testing.assert_allclose(default.covariance(x, np.ones(1))[0, 0, 1], np.exp(-r2 / 2), rtol=1e-12)
    matern = SimulatorPrior(GapGP(Matern32(), lengthscale=1.0)).bind(None, 2, 1, x_std)
    r = 3**0.5 * (1.0**2 + 0.3**2) ** 0.5
    np.testing.assert_allclose(matern.covariance(x, np.ones(1))[0, 0, 1], (1 + r) * np.exp(-r), rtol=1e-12)


def test_simulator_without_gap_has_the_white_error_only() -> None:
    prior = SimulatorPrior(gap=None, white_variance=1e-4).bind(None, 2, 3, np.ones(2))
    c = prior.covariance(jnp.zeros((4, 2)), np.ones(3))
    np.testing.assert_array_equal(c, np.broadcast_to(1e-4 * np.eye(4), (3, 4, 4)))


def test_gp_prior_has_no_simulator_part() -> None:
    m = model("pendulum")
    declared = GPPrior(lengthscale=0.7, scale=1.3)
    assert declared.gap.scale == 1.3
    prior = declared.bind(transition(m, encoding_of(m)), 4, 3, np.full(4, 9.0))
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, 4)))
    np.testing.assert_array_equal(prior.simulate(jax.random.key(0), x, 2), np.zeros((2, 6, 3)))
    line = jnp.asarray(np.pad(np.linspace(-1, 1, 5)[:, None], [(0, 0), (0, 3)]))
    expected = oracles.squared_exponential(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5), 0.7) + 1e-3 * np.eye(5)
    np.testing.assert_allclose(prior.covariance(line, np.ones(3))[1], expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: GapGP(lengthscale_units="data"), "prior.gap.lengthscale_units: got 'data'; allowed are normalised and raw"),
        (lambda: GapGP(lengthscale=0.0), "prior.gap.lengthscale: got 0.0; it must be positive"),
        (lambda: GapGP(scale="big"), "prior.gap.scale: got 'big'; allowed are declared, auto and a number"),
        (lambda: GapGP(scale=-1.0), "prior.gap.scale: got -1.0; a number must be >= 0"),
        (lambda: SimulatorPrior(draws=1), "prior.draws: got 1; a covariance needs at least 2"),
        (lambda: SimulatorPrior(white_variance=0.0), "prior.white_variance: got 0.0; it must be positive"),
    ],
)  # fmt: skip
def test_wrong_declarations(build: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build()  # type: ignore[operator]


def test_infinity_is_lost_in_either_precision() -> None:
    draws = np.array([[[1.0]], [[np.inf]], [[2.0]]])
    for enabled in (True, False):
        with jax.enable_x64(enabled):
            np.testing.assert_array_equal(followed(draws, np.inf), [True, False, True])
