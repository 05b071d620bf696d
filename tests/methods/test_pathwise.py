"""Paths of the posterior against its closed form, and networks against the paths."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from test_methods import EDGE, FIXED, GRID, NOISE, PARAMS, X, predicted, prior_of, problem_of, run, setting_of

from simpel_cli.errors import ConfigError
from simpel_cli.inference.networks import MLP
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Bank, Inference, Normaliser, Problem, pad_rows, padded_length
from simpel_cli.methods.pathwise import Pathwise
from simpel_cli.priors.function_prior import FunctionPrior
from simpel_cli.priors.gaussian_process import SquaredExponential
from simpel_cli.priors.marginal_likelihood import evenly
from simpel_cli.reporting.fit import used

KAPPA, LENGTH = 0.5, 1.0
FEW: dict[str, Any] = {"network": MLP((2,)), "batch": 4, "pool": 32, "features": 500}
MANY = Pathwise(particles=2500, noise=FIXED, **FEW)


def noisy(scale: float = NOISE, x: np.ndarray = X) -> np.ndarray:
    return 1.3 * x - 0.4 + 0.3 * np.sin(2 * x) + scale * np.random.default_rng(7).normal(size=x.shape)


def rule_of(method: Pathwise, problem: Problem, draws: int = 7000, **changed: Any) -> Inference:
    return method.bind(setting_of(prior_of(gap=True)._replace(draws=draws, **changed)), problem)


def drawn(rule: Inference, seed: int = 0) -> tuple[Any, Any]:
    state = rule.init(jax.random.key(seed))
    return state, rule.draw(jax.random.key(seed + 1), state)


def law(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Prior covariance: slope and offset of the line, and the gap."""
    return 3.0 * a @ b.T + 0.25 + KAPPA**2 * oracles.squared_exponential(a[:, 0], b[:, 0], LENGTH)


def exact(at: np.ndarray, y: np.ndarray, x: np.ndarray = X, noise: float = NOISE) -> tuple[np.ndarray, np.ndarray]:
    mean, spread = oracles.gp_posterior(law(x, x), law(at, x), law(at, at), y[:, 0], noise)
    return mean, spread


def test_paths_have_mean_and_covariance_of_the_posterior() -> None:
    rows = 3
    x, y = X[:rows], noisy()[:rows]
    _, targets = drawn(rule_of(MANY, problem_of(y, KAPPA, x)))
    at, h = np.asarray(targets.x)[: 32 + rows], np.asarray(targets.h)[:, : 32 + rows, 0]
    mean, spread = exact(at, y, x)
    np.testing.assert_allclose(h[:, 32:].mean(axis=0), mean[32:], atol=0.02)  # at the data
    prior_std = np.sqrt(np.diag(law(at, at)))
    np.testing.assert_allclose(h.mean(axis=0), mean, atol=0.02 * prior_std.max())
    np.testing.assert_allclose(np.cov(h.T), spread, atol=0.03 * spread.max() + 0.002)


@pytest.mark.parametrize("relevance", [None, np.array([[2.0], [0.7]])], ids=["declared", "chosen"])
def test_paths_of_two_outputs_in_units_of_their_own(relevance: np.ndarray | None) -> None:
    """Normalisers, scales of the gap, lengthscales and a white model error that are not 1, 0 and nothing."""
    white, kappas = 0.02, np.array([0.5, 0.2])
    reach = [2.0, 2.0] if relevance is None else relevance[:, 0].tolist()
    scale = Normaliser(np.array([0.5]), np.array([2.0]), np.array([3.0, -1.0]), np.array([2.0, 0.5]))

    def two(x: jax.Array, phi: jax.Array) -> jax.Array:
        return jnp.concatenate([phi[:1] * x + phi[1:], phi[1:] * x])

    y = (np.concatenate([1.3 * X - 0.4, 0.3 * X], axis=1) - scale.y_mean) / scale.y_std + 0.2 * np.sin(X)
    pad = padded_length(len(X))
    problem = jax.tree.map(jnp.asarray, Problem(
        pad_rows(X, pad), pad_rows(y, pad), np.array(len(X), np.int32), scale, kappas, np.full(2, NOISE), np.full(2, 1e-3),
        gap_relevance=relevance,
    ))  # fmt: skip
    prior = FunctionPrior(7000, white, SquaredExponential(), np.full(1, 2.0), PARAMS, two, 1, 2)
    rule = MANY.bind(setting_of(prior), problem)
    state, targets = drawn(rule)
    at = 0.5 + 2.0 * np.asarray(targets.x)[: 32 + len(X)]  # data units
    total = np.sqrt(NOISE**2 + white)
    np.testing.assert_allclose(rule.predict(state, jnp.asarray(X)).noise_std, total * scale.y_std, rtol=1e-6)

    def of(a: np.ndarray, b: np.ndarray, i: int) -> np.ndarray:
        draws = (3.0 * a @ b.T + 0.25) / 4 if i == 0 else a @ b.T
        return draws + kappas[i] ** 2 * oracles.squared_exponential(a[:, 0] / 2 * reach[i], b[:, 0] / 2 * reach[i], 1.0)

    for i, centre in enumerate((-1.5, 2.0)):
        mean, spread = oracles.gp_posterior(of(X, X, i), of(at, X, i), of(at, at, i), y[:, i] - centre, total)
        h = np.asarray(targets.h)[:, : 32 + len(X), i]
        np.testing.assert_allclose(h.mean(axis=0), mean + centre, atol=0.025)
        np.testing.assert_allclose(h.std(axis=0), np.sqrt(np.diag(spread)), rtol=0.1, atol=0.003)


def test_without_data_the_paths_are_those_of_the_prior() -> None:
    _, targets = drawn(rule_of(MANY, problem_of(noisy(), KAPPA)._replace(m=jnp.int32(0))))
    at, h = np.asarray(targets.x)[:32], np.asarray(targets.h)[:, :32, 0]
    spread = law(at, at)
    np.testing.assert_allclose(h.mean(axis=0), 0, atol=0.05 * np.sqrt(spread.max()))
    np.testing.assert_allclose(np.cov(h.T), spread, atol=0.06 * spread.max())


def test_gaps_of_two_outputs_are_different_functions() -> None:
    problem = problem_of(noisy(), KAPPA)
    both = problem._replace(
        y=jnp.tile(problem.y, (1, 2)), gap_scale=jnp.full(2, KAPPA), noise_init=jnp.full(2, NOISE),
        noise_floor=jnp.full(2, 1e-3), normaliser=problem.normaliser._replace(y_mean=jnp.zeros(2), y_std=jnp.ones(2)),
    )  # fmt: skip
    prior = FunctionPrior(2, 1e-8, SquaredExponential(), np.ones(1), (), None, 0, 2)
    _, targets = drawn(MANY.bind(setting_of(prior), both))
    h = np.asarray(targets.h)
    middle = int(np.argmax(h[:, :32, 0].std(axis=0)))  # least known
    assert abs(np.corrcoef(h[:, middle, 0], h[:, middle, 1])[0, 1]) < 0.1


def test_networks_look_at_the_data_too_where_the_domain_is_elsewhere() -> None:
    method = Pathwise(steps=1500, particles=4, network=MLP((32, 32)), pool=32, features=500, noise=FIXED)
    y = noisy()
    prior = prior_of(gap=True)._replace(draws=1000)
    setting = setting_of(prior)._replace(
        sample_inputs=lambda key, n: jax.random.uniform(key, (n, 1), minval=8.0, maxval=9.0)
    )
    rule = method.bind(setting, problem_of(y, KAPPA))
    found = rule.predict(run(rule, method.steps), jnp.asarray(X)).mean[:, 0]
    assert np.sqrt(np.mean((np.asarray(found) - exact(X, y)[0]) ** 2)) < 0.15
    _, targets = drawn(rule)
    assert float(targets.x[:32].min()) > 7


def test_paths_stay_the_same_functions_from_stretch_to_stretch() -> None:
    rule = rule_of(Pathwise(particles=6, noise=FIXED, **FEW), problem_of(noisy(), KAPPA), draws=400)
    state, first = drawn(rule)
    second = rule.draw(jax.random.key(99), state)
    assert np.abs(np.asarray(first.x[:32] - second.x[:32])).min() > 0  # other points of the domain
    np.testing.assert_allclose(first.h[:, 32:], second.h[:, 32:], atol=1e-6)
    assert float(jnp.std(first.h, axis=0).min()) > 0.01  # and not one function


def test_values_at_the_data_are_those_of_the_same_path_anywhere() -> None:
    x, y = X[:12], noisy()[:12]
    setting = setting_of(prior_of(gap=True)._replace(draws=400))._replace(
        sample_inputs=lambda key, n: jnp.asarray(x[:n])
    )
    rule = Pathwise(particles=6, noise=FIXED, **FEW | {"pool": 12}).bind(setting, problem_of(y, KAPPA, x))
    _, targets = drawn(rule)
    np.testing.assert_allclose(targets.h[:, :12], targets.h[:, 12:24], atol=2e-4)  # a gap in single precision


def test_paths_of_another_seed_are_others() -> None:
    rule = rule_of(Pathwise(particles=6, noise=FIXED, **FEW), problem_of(noisy(), KAPPA), draws=400)
    (_, one), (_, other) = drawn(rule, 0), drawn(rule, 5)
    assert np.abs(np.asarray(one.h[:, 32:] - other.h[:, 32:])).mean() > 0.005


@pytest.mark.slow
def test_networks_learn_the_paths() -> None:
    method = Pathwise(steps=2000, particles=16, network=MLP((32, 32)), pool=128, features=500, noise=FIXED)
    y = noisy()
    found = predicted(method, y, prior_of(gap=True)._replace(draws=2000), KAPPA)
    mean, spread = exact(GRID, y)
    std = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(found.mean[:, 0], mean, atol=1.0 * std.max())
    assert np.sqrt(np.mean((np.asarray(found.mean[:, 0]) - mean) ** 2)) < 0.35 * std.mean()
    np.testing.assert_allclose(np.mean(found.epistemic_std), std.mean(), rtol=0.25)
    np.testing.assert_allclose(found.noise_std, NOISE, rtol=1e-3)


@pytest.mark.parametrize("noise", [0.02, pytest.param(0.3, marks=pytest.mark.slow)])
def test_the_noise_is_that_of_the_largest_marginal_likelihood(noise: float) -> None:
    x = np.random.default_rng(3).uniform(-EDGE, EDGE, (200, 1))
    problem = problem_of(noisy(noise, x), KAPPA, x)
    state, _ = drawn(rule_of(Pathwise(particles=4, **FEW), problem, draws=1000))
    learned = rule_of(Pathwise(particles=4, **FEW), problem).predict(state, jnp.asarray(GRID)).noise_std
    np.testing.assert_allclose(learned, noise, rtol=0.2)


def test_rows_beyond_those_conditioned_on_and_padding_tell_nothing() -> None:
    method = Pathwise(particles=6, noise=FIXED, most_rows=8, **FEW)
    y = noisy()
    base = problem_of(y, KAPPA)
    seen = np.asarray(evenly(len(base.x), base.m, 8)[0])
    _, one = drawn(rule_of(method, base, draws=400))
    other = np.array(base.y)
    other[np.setdiff1d(np.arange(len(other)), seen)] += 7.0
    _, same = drawn(rule_of(method, base._replace(y=jnp.asarray(other)), draws=400))
    np.testing.assert_array_equal(one.h, same.h)
    other[seen[2]] += 7.0
    _, moved = drawn(rule_of(method, base._replace(y=jnp.asarray(other)), draws=400))
    assert np.abs(np.asarray(one.h - moved.h)).max() > 0.5


def test_padding_tells_nothing() -> None:
    method, few = Pathwise(particles=6, **FEW), problem_of(noisy()[:5], KAPPA, X[:5])
    junk = np.arange(len(few.x)) >= 5
    other = few._replace(x=few.x + 0.7 * junk[:, None], y=few.y + 9.0 * junk[:, None])
    (state, one), (later, same) = (drawn(rule_of(method, problem, draws=400)) for problem in (few, other))
    np.testing.assert_allclose(one.h[:, :37], same.h[:, :37], atol=1e-6)
    np.testing.assert_allclose(state.networks.noise, later.networks.noise, rtol=1e-6)
    rules = [rule_of(method, problem, draws=400) for problem in (few, other)]
    one, same = (np.asarray(rule.predict(run(rule, 30), jnp.asarray(GRID)).mean) for rule in rules)
    np.testing.assert_allclose(one, same, atol=1e-3)


@pytest.mark.parametrize(("padded", "rows", "most"), [(32, 5, 64), (1024, 600, 512), (1024, 600, 1000), (64, 64, 1)])
def test_rows_are_chosen_evenly_and_once(padded: int, rows: int, most: int) -> None:
    chosen, count = evenly(padded, np.array(rows, np.int32), most)
    assert int(count) == min(rows, most)
    real = np.asarray(chosen)[: int(count)]
    assert len(set(real.tolist())) == int(count)
    assert real.max() < rows
    assert np.ptp(np.diff(real), axis=0) <= 1 if len(real) > 1 else real.tolist() == [0]


def test_a_world_brings_its_draws_along() -> None:
    """The same simulator, asked once at fixed points."""
    y, pad, pool = noisy(), padded_length(len(X)), 32
    points = np.concatenate([np.asarray(problem_of(y).x), np.linspace(-EDGE, EDGE, pool)[:, None]])
    phi = np.random.default_rng(0).uniform([-3, -0.5], [3, 0.5], (6000, 2))  # the same mean
    samples = (points[:, :, None] * phi[None, None, :, 0] + phi[None, None, :, 1]).astype(np.float64)
    problem = problem_of(y, KAPPA)._replace(bank=Bank(jnp.asarray(points), jnp.asarray(samples)))
    method = Pathwise(particles=2000, noise=FIXED, **FEW)
    state, targets = drawn(rule_of(method, problem, draws=6000, step=None))
    np.testing.assert_allclose(targets.x[:pool, 0], points[pad:, 0])
    np.testing.assert_allclose(np.asarray(targets.h)[:, :pool, 0].mean(axis=0), exact(points[pad:], y)[0], atol=0.05)
    again = rule_of(method, problem, draws=6000, step=None).draw(jax.random.key(50), state)
    np.testing.assert_array_equal(again.h, targets.h)


def test_a_prior_without_a_simulator_or_without_a_gap() -> None:
    y = noisy()
    without = FunctionPrior(2, 1e-8, SquaredExponential(), np.ones(1), (), None, 0, 1)
    state = (rule := MANY.bind(setting_of(without), problem_of(y, KAPPA))).init(jax.random.key(0))
    h = np.asarray(rule.draw(jax.random.key(1), state).h)[:, 32 : 32 + len(X), 0]
    known = KAPPA**2 * oracles.squared_exponential(X[:, 0], X[:, 0], LENGTH)
    mean, spread = oracles.gp_posterior(known, known, known, y[:, 0], NOISE)
    np.testing.assert_allclose(h.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(h.std(axis=0), np.sqrt(np.diag(spread)), rtol=0.15)
    alone = MANY.bind(setting_of(prior_of()._replace(draws=7000)), problem_of(y))
    h = np.asarray(drawn(alone)[1].h)[:, 32 : 32 + len(X), 0]
    straight = np.polynomial.polynomial.polyfit(X[:, 0], h.T, 1)
    np.testing.assert_allclose(h.T, straight[0][None] + X * straight[1][None], atol=1e-3)  # every path is a line


def test_what_it_cannot_do_is_refused() -> None:
    class Wavy:
        def correlation(self, squared_distance: jax.Array) -> jax.Array:
            return jnp.exp(-squared_distance)

    method, problem = Pathwise(particles=10, noise=FIXED, **FEW), problem_of(noisy())
    with pytest.raises(
        ConfigError, match=r"prior.draws: got 73; method=pathwise needs 74 or more: method.particles \(10\)"
    ):
        rule_of(method, problem, draws=73)
    with pytest.raises(ConfigError, match=r"prior: its kernel Wavy has no `frequencies`"):
        rule_of(method, problem, kernel=Wavy())
    with pytest.raises(ConfigError, match=r"method.pool: got 0; it must be at least 1"):
        Pathwise(pool=0)
    with pytest.raises(ConfigError, match=r"method.learning_rate: got -1.0; it must be positive"):
        Pathwise(learning_rate=-1.0)
    with pytest.raises(
        ConfigError, match=r"method.final_learning_rate: got 1.5; it is the fraction that is left at the end: 0 to 1"
    ):
        Pathwise(final_learning_rate=1.5)


def test_one_path_goes_through_what_is_free_of_noise() -> None:
    quiet = problem_of(noisy(0.0), KAPPA)._replace(noise_init=jnp.full(1, 1e-3), noise_floor=jnp.full(1, 1e-4))
    method = Pathwise(particles=1, noise=NoiseModel(learn=False), **FEW)
    _, targets = drawn(rule_of(method, quiet, draws=500))
    np.testing.assert_allclose(targets.h[0, 32 : 32 + len(X), 0], noisy(0.0)[:, 0], atol=0.005)


@pytest.mark.parametrize(
    ("most", "words"), [(16, "40 transitions used (the method takes 16 of them, evenly"), (40, "40 transitions used,")]
)
def test_what_is_left_out_is_said(most: int, words: str) -> None:
    source = SimpleNamespace(states=("phi",), dt=0.05)
    assert used(Pathwise(most_rows=most), source, 40).startswith(words)
