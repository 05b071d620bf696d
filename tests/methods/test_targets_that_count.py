"""Targets that count more or less than others, and targets that tell nothing of the noise, in every method."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from scipy.stats import multivariate_normal
from test_methods import FIXED, GRID, NOISE, SMALL, N, X, prior_of, problem_of, run, setting_of

from simpel_cli.inference.networks import MLP
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Problem
from simpel_cli.methods.exact_gp import ExactGP
from simpel_cli.methods.fmap import FunctionMAP
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.greybox import GreyBox
from simpel_cli.methods.pathwise import Pathwise
from simpel_cli.methods.svgd import SVGD
from simpel_cli.methods.sysid import SysID
from simpel_cli.priors.function_prior import GPPrior
from simpel_cli.priors.gap_scale import marginal_likelihood_scales
from simpel_cli.priors.marginal_likelihood import best_scales, weighted_spectra
from simpel_cli.priors.noise_law import Moments

KEY = jax.random.key(0)
WHITE = np.random.default_rng(1).normal(size=(N, 1))
Y = 1.2 * X + 0.3 + NOISE * (WHITE - WHITE.mean()) / WHITE.std()


def counting(problem: Problem, precision: np.ndarray, tells: np.ndarray) -> Problem:
    """Rows that count as they say; padding counts as the first does."""
    padded = [
        jnp.asarray(np.pad(a, (0, problem.x.shape[0] - len(a)), constant_values=1.0))[:, None]
        for a in (precision, tells)
    ]
    return problem._replace(precision=padded[0], tells=padded[1], weights=padded[0])


def predicted(method: Any, problem: Problem, *, gap: bool, steps: int) -> Predictive:
    rule = method.bind(setting_of(prior_of(gap)._replace(draws=128)), problem)
    return jax.jit(rule.predict)(run(rule, steps), jnp.asarray(GRID))


@pytest.mark.parametrize(
    ("method", "gap"),
    [(SysID(particles=500, noise=FIXED), False), (ExactGP(SysID(noise=FIXED)), True)],
    ids=["sysid", "gp"],
)
def test_a_target_that_counts_twice_is_two_rows(method: Any, gap: bool) -> None:
    """In closed form, with a known noise."""
    twice = np.arange(N) % 3 == 0
    kappa = 0.3 if gap else 0.0
    rows = np.concatenate([np.arange(N), np.flatnonzero(twice)])
    repeated = predicted(method, problem_of(Y[rows], kappa, X[rows]), gap=gap, steps=30)
    problem = counting(problem_of(Y, kappa), 1.0 + twice, np.ones(N))
    weighted = predicted(method, problem, gap=gap, steps=30)
    np.testing.assert_allclose(weighted.mean, repeated.mean, atol=2e-5)
    np.testing.assert_allclose(weighted.epistemic_std, repeated.epistemic_std, rtol=2e-3, atol=1e-5)
    plain = predicted(method, problem_of(Y, kappa), gap=gap, steps=30)
    assert np.abs(np.asarray(plain.mean - repeated.mean)).max() > 1e-3


WHOLE: dict[str, Any] = SMALL | {"batch": 24, "fresh_points": 4, "pool": 32, "learning_rate": 0.02}
ESTIMATED = {
    "sysid": (SysID(), False, 30),
    "gp": (ExactGP(), True, 1),
    "greybox": (GreyBox(residual=FSVGD(**WHOLE), prior=GPPrior()), False, 600),
    "pathwise": (Pathwise(**SMALL, pool=32, features=64), True, 1),
    "fmap": (FunctionMAP(**WHOLE, precondition=True), True, 600),
    "svgd": (SVGD(**SMALL | {"batch": 24}, learning_rate=0.02), False, 1500),
}


@pytest.mark.parametrize("name", ESTIMATED)
def test_what_was_estimated_does_not_make_the_noise_look_small(name: str) -> None:
    """Half of the targets lie on the line itself; they move the function, but tell nothing of sigma."""
    method, gap, steps = ESTIMATED[name]
    x = np.concatenate([X, X])
    y = np.concatenate([Y, 1.2 * X + 0.3])
    tells = np.concatenate([np.ones(N), np.zeros(N)])
    kappa = 0.5 if gap else 0.0
    fooled = predicted(method, problem_of(y, kappa, x), gap=gap, steps=steps)
    problem = counting(problem_of(y, kappa, x), np.ones(2 * N), tells)
    found = predicted(method, problem, gap=gap, steps=steps)
    assert 0.75 * NOISE < float(found.noise_std[0]) < 1.5 * NOISE
    assert float(fooled.noise_std[0]) < 0.97 * float(found.noise_std[0])


@pytest.mark.parametrize("name", ["sysid", "gp", "fmap", "svgd"])
def test_a_target_that_hardly_counts_drags_nothing(name: str) -> None:
    method, gap, steps = ESTIMATED[name]
    y, precision = Y.copy(), np.ones(N)
    end = int(np.argmax(X))
    y[end] += 40 * NOISE
    precision[end] = 1e-6
    kappa = 0.5 if gap else 0.0
    found = predicted(
        method, counting(problem_of(y, kappa), precision, (precision == 1).astype(float)), gap=gap, steps=steps
    )
    near = np.abs(GRID[:, 0]) < 1.5
    assert np.max(np.abs(np.asarray(found.mean) - (1.2 * GRID + 0.3))[near]) < 0.15
    assert float(found.noise_std[0]) < 1.6 * NOISE


COUNTS, MODEL_ERROR, KAPPA = np.where(np.arange(N) % 3 == 0, 0.05, 1.5), 0.2**2, 0.4


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return KAPPA**2 * oracles.squared_exponential(a[:, 0], b[:, 0], 1.0)


def test_white_model_error_does_not_shrink_with_the_weight_of_a_gps_row() -> None:
    """y ~ N(g, kappa^2 K + w I + sigma^2 W^-1) about the simulator that was identified, in closed form."""
    y = Y + 0.2 * np.random.default_rng(3).normal(size=Y.shape)
    setting = setting_of(prior_of(True)._replace(draws=128, white_variance=MODEL_ERROR))
    problem = counting(problem_of(y, KAPPA), COUNTS, np.ones(N))
    rule = ExactGP(SysID(noise=FIXED), particles=200).bind(setting, problem)
    state = run(rule, 1)
    found = rule.predict(state, jnp.asarray(GRID))
    a, b = np.asarray(state.found.phi)
    seen = apart(X, X) + np.diag(MODEL_ERROR + NOISE**2 / COUNTS)
    gain = np.linalg.solve(seen, apart(X, GRID)).T
    np.testing.assert_allclose(found.mean, a * GRID + b + gain @ (y - a * X - b), atol=2e-5)
    spread = np.diag(apart(GRID, GRID) - gain @ apart(X, GRID)) + MODEL_ERROR
    np.testing.assert_allclose(found.epistemic_std[:, 0], np.sqrt(spread), rtol=2e-3)


def test_nor_with_that_of_a_path() -> None:
    y = Y + 0.2 * np.random.default_rng(3).normal(size=Y.shape)
    method = Pathwise(particles=2500, noise=FIXED, network=MLP((2,)), batch=4, pool=32, features=500)
    prior = prior_of(True)._replace(draws=7000, white_variance=MODEL_ERROR)
    rule = method.bind(setting_of(prior), counting(problem_of(y, KAPPA), COUNTS, np.ones(N)))
    state = rule.init(KEY)
    h = np.asarray(rule.draw(jax.random.fold_in(KEY, 1), state).h)[:, 32 : 32 + N, 0]

    law = 3.0 * X @ X.T + 0.25 + apart(X, X)
    gain = np.linalg.solve(law + np.diag(MODEL_ERROR + NOISE**2 / COUNTS), law).T
    np.testing.assert_allclose(h.mean(axis=0), (gain @ y)[:, 0], atol=0.02)
    np.testing.assert_allclose(h.std(axis=0), np.sqrt(np.diag(law - gain @ law)), rtol=0.1)


def test_nor_in_the_marginal_likelihood_of_the_noise() -> None:
    """Sigma at which the penalised marginal likelihood is largest, by a fine grid of it."""
    random = np.random.default_rng(5)
    law = apart(X, X)
    samples, counts = np.zeros((2, N, 1)), COUNTS[:, None]
    truth = law + np.diag(MODEL_ERROR + NOISE**2 / COUNTS)
    y = np.linalg.cholesky(truth) @ random.normal(size=(N, 1))
    moments = Moments(samples, law[None] / KAPPA**2, y, MODEL_ERROR, counts)
    found = marginal_likelihood_scales(*moments.whitened(0), 0.3, moments.white_of(0), KAPPA).noise
    levels = np.geomspace(0.01, 1, 2001)
    minus = [
        -multivariate_normal(np.zeros(N), law + np.diag(MODEL_ERROR + sigma**2 / COUNTS)).logpdf(y[:, 0])
        + 0.5 * np.log(sigma / 0.3) ** 2
        for sigma in levels
    ]
    assert found == pytest.approx(levels[int(np.argmin(minus))], rel=5e-3)
    free = marginal_likelihood_scales(*moments.whitened(0), 0.3, moments.white_of(0))
    assert 0.3 * KAPPA < free.gap < 2 * KAPPA
    problem = counting(problem_of(y, KAPPA), COUNTS, np.ones(N))
    spectra = weighted_spectra(
        jnp.asarray(np.pad(law / KAPPA**2, (0, problem.x.shape[0] - N)))[None], problem.y, problem.m, problem.weights, None,
        problem.gap_scale, MODEL_ERROR,
    )  # fmt: skip
    best = best_scales(spectra, jnp.ones(1), 0.0, 1.0, np.full(1, 0.01), np.full(1, 0.3))
    assert float(best.noise[0]) == pytest.approx(found, rel=0.08)  # of levels a ninth apart


def test_moments_are_those_of_the_rows_that_tell() -> None:
    random = np.random.default_rng(0)
    samples, targets = random.normal(size=(64, 8, 1)), random.normal(size=(8, 1))
    precision, tells = random.uniform(0.5, 2, (8, 1)), np.ones((8, 1))
    tells[[1, 4]] = 0
    moments = Moments(samples, np.eye(8)[None], targets, 0.0, precision, tells)
    rows = [0, 2, 3, 5, 6, 7]
    root = np.sqrt(precision[rows, 0])
    covariance, residual = moments.of_output(0, 0.5)
    plain = np.cov(samples[:, rows, 0], rowvar=False) + 0.25 * np.eye(6)
    np.testing.assert_allclose(covariance, plain * np.outer(root, root))
    np.testing.assert_allclose(residual, (targets[rows, 0] - samples[:, rows, 0].mean(axis=0)) * root)
    assert len(moments._replace(tells=np.zeros((8, 1))).rows(0)) == 8
