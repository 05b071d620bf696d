"""Whole FSVGD, networks and all, against the exact Gaussian-process posterior in one dimension.

Finite particles come out narrower than the posterior by a known margin (LEARNING.md), most so where they are few.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from simpel_cli.inference import loop
from simpel_cli.inference.networks import MLP
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Normaliser, Problem, Setting, pad_rows, padded_length
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.priors.function_prior import GPPrior
from simpel_cli.scores.gaussian import Gaussian

OPTIMISED = {"xla_backend_optimization_level": 1}  # `make test` asks for 0, with which a step takes four times as long
LENGTHSCALE, WHITE, NOISE, EDGE = 0.6, 1e-4, 0.1, 1.7
X = np.array([-1.2, -0.9, -0.3, 0.4, 0.5, 1.3])
Y = np.sin(2 * X) + NOISE * np.random.default_rng(0).standard_normal(6)
GRID = np.linspace(-EDGE, EDGE, 35)
INSIDE = (X.min() <= GRID) & (X.max() >= GRID)

METHOD = FSVGD(
    steps=2500,
    particles=50,
    network=MLP((64, 64)),
    learning_rate=3e-3,
    weight_decay=0.0,
    batch=32,
    fresh_points=16,
    bandwidth=1.0,
    pool=256,  # with which the bars were measured; at the edge of the box a seed in five misses them by 0.003, with 1024, too
    sets=64,
    noise=NoiseModel(learn=False),
)
SMALL = dataclasses.replace(METHOD, steps=2000, particles=20, network=MLP((32, 32)))


def exact(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the function that the prior declares, white part included."""

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return oracles.squared_exponential(a, b, LENGTHSCALE)

    train, test = k(X, X) + WHITE * np.eye(len(X)), k(grid, grid) + WHITE * np.eye(len(grid))
    mean, covariance = oracles.gp_posterior(train, k(grid, X), test, Y, NOISE)
    return mean, np.sqrt(np.diag(covariance))


@pytest.fixture(scope="module", autouse=True)
def _optimised() -> Iterator[None]:
    """Long fits of small programs: worth a longer compilation."""
    with pytest.MonkeyPatch.context() as patch:
        compile_ = jax.stages.Lowered.compile
        patch.setattr(jax.stages.Lowered, "compile", lambda lowered: compile_(lowered, compiler_options=OPTIMISED))
        yield


class Fitted(NamedTuple):
    mean: np.ndarray  # (seeds, n)
    std: np.ndarray  # (seeds, n)


def fitted(method: FSVGD, at: np.ndarray = GRID, seeds: tuple[int, ...] = (0,)) -> Fitted:
    one, zero = np.ones(1), np.zeros(1)
    length = padded_length(len(X))
    problem = Problem(
        x=pad_rows(X[:, None], length),
        y=pad_rows(Y[:, None], length),
        m=np.array(len(X), np.int32),
        normaliser=Normaliser(zero, one, zero, one),
        gap_scale=one,
        noise_init=NOISE * one,
        noise_floor=0.01 * NOISE * one,
    )

    def stack(a: np.ndarray) -> jax.Array:
        return jnp.stack([jnp.asarray(a, jnp.float32 if a.dtype.kind == "f" else None)] * len(seeds))

    def uniform(key: jax.Array, n: int) -> jax.Array:
        return jax.random.uniform(key, (n, 1), jnp.float32, -EDGE, EDGE)

    problems = jax.tree.map(stack, problem)
    setting = Setting(GPPrior(lengthscale=LENGTHSCALE, white_variance=WHITE).bind(None, 1, 1, one), Gaussian(), uniform)
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    program = loop.compiled(lambda p: method.bind(setting, p), problems, keys, 500)
    *_, last = loop.train(program, method.steps)

    def predict(problem: Problem, state: Any) -> jax.Array:
        return method.bind(setting, problem).predict(state, jnp.asarray(at, jnp.float32)[:, None]).particles[..., 0]

    particles = np.asarray(jax.vmap(predict)(problems, last.state), float)
    return Fitted(particles.mean(axis=1), particles.std(axis=1))


def assert_close_to_exact(fit: Fitted, where: np.ndarray) -> None:
    """The bars of LEARNING.md at every point of the grid that `where` marks."""
    mean, std = exact(GRID)
    error, ratio = np.abs(fit.mean - mean)[:, where], (fit.std / std)[:, where]
    assert error.max() < 0.02
    assert ratio.min() > 0.8
    assert ratio.max() < 1.05


def test_posterior_between_the_data_is_that_of_the_gaussian_process() -> None:
    assert_close_to_exact(fitted(METHOD), INSIDE)


@pytest.mark.slow
def test_posterior_is_that_of_the_gaussian_process_everywhere_for_three_seeds() -> None:
    # beyond the data the likelihood no longer pulls, and the means take four times as long to arrive
    assert_close_to_exact(fitted(dataclasses.replace(METHOD, steps=10000), seeds=(0, 1, 2)), np.full(len(GRID), True))


@pytest.fixture(scope="module")
def reference() -> Fitted:
    return fitted(SMALL)


def assert_same_posterior(one: Fitted, other: Fitted, rtol: float) -> None:
    np.testing.assert_allclose(one.std[0, INSIDE].mean(), other.std[0, INSIDE].mean(), rtol=rtol)
    np.testing.assert_allclose(one.mean[0, INSIDE], other.mean[0, INSIDE], atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("points", [8, 32])
def test_posterior_does_not_depend_on_the_number_of_measurement_points(reference: Fitted, points: int) -> None:
    assert_same_posterior(fitted(dataclasses.replace(SMALL, fresh_points=points)), reference, 0.06)


def test_likelihood_of_a_batch_stands_for_all_data(reference: Fitted) -> None:
    # unscaled, 3 points instead of 32 would count as a tenth of the data. Batches cost some spread: measured 8 %
    assert_same_posterior(fitted(dataclasses.replace(SMALL, batch=3)), reference, 0.15)


@pytest.mark.slow  # a limit of the test above
def test_without_prior_the_fit_is_that_of_the_data() -> None:
    free, bound = (fitted(dataclasses.replace(SMALL, prior_weight=w), at=np.append(X, GRID)) for w in (0.0, 1.0))
    data, rest = slice(0, len(X)), np.append(np.zeros(len(X), bool), INSIDE)
    residuals = [np.abs(f.mean[0, data] - Y).max() for f in (free, bound, Fitted(*(a[None] for a in exact(X))))]
    assert residuals[0] < 0.005
    assert min(residuals[1:]) > 0.012  # the prior smooths, and the exact posterior does as much
    assert np.all(free.std[0, data] < bound.std[0, data])
    assert free.std[0, rest].mean() > 2 * bound.std[0, rest].mean()  # nothing holds the particles together elsewhere
