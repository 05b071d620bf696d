"""Methods that identify a simulator learn how far groups are apart, and predict a group never seen from the population."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from test_methods import FIXED, SMALL, run

from simpel_cli.inference.protocols import Normaliser, Problem, Setting, pad_rows, padded_length
from simpel_cli.methods.exact_gp import ExactGP
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.greybox import GreyBox
from simpel_cli.methods.populations import Populations, Told
from simpel_cli.methods.sysid import State, SysID, identified
from simpel_cli.priors.function_prior import FunctionPrior, GPPrior
from simpel_cli.scores.gaussian import Gaussian
from simulators.groups import grouping
from simulators.model import Quantity

GROUPS, ROWS, NOISE = 12, 8, 0.1
NAMES = tuple(f"ball_{i}" for i in range(GROUPS))
COMMON = Quantity("c", "1", -20.0, 20.0)
HOW = grouping(COMMON, "ball", NAMES, (0.0, 4.0))
RATIO = grouping(Quantity("c", "1", 0.01, 20.0), "ball", NAMES, (0.0, 4.0))
SLOTS = GROUPS + 1
MIDDLE, SPREAD = 3.0, 0.5


def prior_of(how: Any = HOW, common: Quantity = COMMON, gap: bool = False) -> FunctionPrior:
    """One-way layout: a row has the value of its group; the first input does nothing."""

    def value(x: jax.Array, phi: jax.Array) -> jax.Array:
        off = phi[1:2] * jnp.sum(x[1:] * phi[2:])
        return phi[:1] * jnp.exp(off) if how.ratio else phi[:1] + off

    kernel = GPPrior().kernel if gap else None
    return FunctionPrior(64, 1e-8, kernel, np.ones(1 + SLOTS), (common, *how.own), value, 1, 1)


def rows_of(group: int, n: int) -> np.ndarray:
    return np.column_stack([np.linspace(-1, 1, n), np.tile(np.eye(SLOTS)[group], (n, 1))])


def problem_of(values: np.ndarray, seed: int, dtype: str = "float64", kappa: float = 0.0) -> Problem:
    white = np.random.default_rng(seed).normal(size=(GROUPS * ROWS, 1))
    x = np.concatenate([rows_of(g, ROWS) for g in range(GROUPS)])
    y = np.repeat(values, ROWS)[:, None] + NOISE * white
    length, one = padded_length(len(x)), np.ones(1)
    problem = Problem(
        x=pad_rows(x, length), y=pad_rows(y, length), m=np.array(len(x), np.int32),
        normaliser=Normaliser(np.zeros(1 + SLOTS), np.ones(1 + SLOTS), 0 * one, one), gap_scale=kappa * one,
        noise_init=NOISE * one, noise_floor=0.01 * NOISE * one,
    )  # fmt: skip
    return jax.tree.map(lambda a: jnp.asarray(a, dtype if a.dtype == np.float64 else a.dtype), problem)


def setting_of(prior: FunctionPrior) -> Setting:
    def inputs(key: Any, n: int) -> jax.Array:
        groups = jax.nn.one_hot(jax.random.randint(key, (n,), 0, SLOTS), SLOTS, dtype=jnp.float64)
        return jnp.concatenate([jax.random.uniform(key, (n, 1), jnp.float64, -1.0, 1.0), groups], axis=1)

    return Setting(prior, Gaussian(), inputs)


def drawn_values(seed: int, spread: float = SPREAD) -> np.ndarray:
    white = np.random.default_rng(100 + seed).normal(size=GROUPS)
    return MIDDLE + spread * white


def spread_found(problem: Problem, prior: FunctionPrior | None = None, method: SysID | None = None) -> float:
    found = identified(method or SysID(noise=FIXED), setting_of(prior or prior_of()), problem, jax.random.key(0), 1)
    return float(found.phi[1])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_spread_of_a_balanced_one_way_layout_is_that_of_analysis_of_variance(dtype: str) -> None:
    """Which REML comes to there: s^2 = variance of the group means - sigma^2/n; Searle, Casella and McCulloch (1992), 3.8."""
    problem = problem_of(drawn_values(0), 0, dtype)
    means = np.asarray(problem.y)[: GROUPS * ROWS, 0].reshape(GROUPS, ROWS).mean(axis=1)
    exact = np.sqrt(means.var(ddof=1) - NOISE**2 / ROWS)
    assert spread_found(problem) == pytest.approx(exact, rel=0.01)


def test_groups_keep_their_values_and_any_start_finds_the_spread() -> None:
    values = drawn_values(0)
    problem, prior = problem_of(values, 0), prior_of()
    each = []
    for starts, seed in ((1, 0), (1, 1), (8, 2)):
        method = SysID(starts=starts, steps=100, noise=FIXED)
        found = identified(method, setting_of(prior), problem, jax.random.key(seed), 1)
        phi = np.asarray(found.phi)
        np.testing.assert_allclose(phi[0] + phi[1] * phi[2:-1], values, atol=4 * NOISE / np.sqrt(ROWS))
        assert phi[-1] == pytest.approx(0.0, abs=1e-3)  # no data tell of what was never seen
        each.append(phi[1])
    np.testing.assert_allclose(each, each[0], rtol=0.03)


def test_groups_that_are_alike_have_hardly_a_spread() -> None:
    """Less than what tells one group's value from another's."""
    for seed in range(5):
        assert spread_found(problem_of(np.full(GROUPS, MIDDLE), seed)) < 1.5 * NOISE / np.sqrt(ROWS)


def test_a_spread_stays_in_its_range() -> None:
    problem = problem_of(drawn_values(0), 0)
    for low, high in ((0.0, 0.2), (1.0, 3.0)):
        found = spread_found(problem, prior_of(grouping(COMMON, "ball", NAMES, (low, high))))
        assert found == pytest.approx(high if high < SPREAD else low, rel=0.03)


def test_loss_and_what_is_paid_are_the_evidence_of_a_spread() -> None:
    """Of the linear model in closed form, c integrated out; a start counts by it, not by the posterior density."""
    problem = problem_of(drawn_values(0), 0)
    y = np.asarray(problem.y)[: GROUPS * ROWS, 0]
    layout = np.kron(np.eye(GROUPS), np.ones((ROWS, 1)))
    found, exact, density = [], [], []
    for s in (0.2, 0.5, 1.5):
        prior = prior_of(grouping(COMMON, "ball", NAMES, (s, 1.0001 * s)))
        state = run(SysID(starts=2, noise=FIXED).bind(setting_of(prior), problem), 60)
        assert state.told is not None
        found.append(float(jnp.min(state.loss + state.told.paid)))
        density.append(float(jnp.min(state.loss)))
        v = NOISE**2 * np.eye(len(y)) + s**2 * layout @ layout.T
        weights = np.linalg.solve(v, np.ones(len(y)))
        left = y - weights @ y / weights.sum()
        exact.append((np.linalg.slogdet(v)[1] + np.log(weights.sum()) + left @ np.linalg.solve(v, left)) / 2)
    np.testing.assert_allclose(np.diff(found), np.diff(exact), atol=0.02)
    assert np.argmin(found) == 1
    assert np.argmin(density) == 2
    two = State(*jnp.zeros((5, 2)), Told(jnp.zeros((2, 1)), jnp.array([3.0, 0.0])))
    assert int(two._replace(loss=jnp.array([0.0, 1.0])).best) == 1


def test_other_spreads_leave_groups_and_their_derivatives_as_they_are() -> None:
    prior, populations = prior_of(RATIO, Quantity("c", "1", 0.01, 20.0)), Populations(prior_of(RATIO).params)
    x = jnp.asarray(np.concatenate([rows_of(g, 1) for g in range(GROUPS)]))
    u = jnp.asarray([0.5, 0.1, *np.random.default_rng(0).normal(size=GROUPS), 0.0])

    def simulated(u: jax.Array) -> jax.Array:
        assert prior.step is not None
        phi = jnp.concatenate([20 * u[:1], 4 * u[1:2], u[2:]])
        return jax.vmap(prior.step, in_axes=(0, None))(x, phi)[:, 0]

    moved = populations.moved(u, Told(jnp.array([GROUPS / 4]), jnp.zeros(())), 6.0)
    ratio = float(moved.u[1] / u[1])
    assert ratio == pytest.approx(np.sqrt(np.sum(u[2:-1] ** 2) / (GROUPS / 4)))
    assert not moved.settled
    np.testing.assert_allclose(simulated(moved.u), simulated(u))
    before, after = (np.delete(np.asarray(jax.jacobian(simulated)(at)), 1, axis=1) for at in (u, moved.u))
    np.testing.assert_allclose(after, before * np.delete(np.asarray(moved.stretch), 1)[None])
    assert float(moved.loss) == pytest.approx(0.5 * float(jnp.sum(moved.u[2:] ** 2) - jnp.sum(u[2:] ** 2)))


def test_a_spread_is_drawn_as_far_as_it_is_known() -> None:
    populations = Populations(prior_of().params)
    u = jnp.tile(jnp.asarray([0.5, 0.1, *np.ones(GROUPS), 0.0])[None], (4000, 1))
    white = jax.random.normal(jax.random.key(0), u.shape, u.dtype)
    draws = np.asarray(populations.drawn(u, jnp.array([8.0]), white))
    assert np.log(draws[:, 1]).std() == pytest.approx(1 / np.sqrt(2 * 8), rel=0.05)
    np.testing.assert_allclose(draws[:, 1] * draws[:, 2], 0.1)  # groups that are known stay
    np.testing.assert_array_equal(draws[:, -1], white[:, -1])


def test_information_that_cannot_be_inverted_tells_no_group() -> None:
    populations = Populations(prior_of().params)
    count = len(prior_of().params)
    told = populations.told(jnp.full((count, count), jnp.nan), jnp.zeros(count, bool))
    np.testing.assert_array_equal(told.gamma, 0.0)
    assert told.paid == np.inf


METHODS = {
    "sysid": (SysID(particles=200, noise=FIXED), 0.0, 100),
    "gp": (ExactGP(SysID(noise=FIXED), particles=200), 1e-3, 1),
    "greybox": (
        GreyBox(
            residual=FSVGD(**SMALL | {"particles": 50, "batch": 24}, fresh_points=4, pool=32, learning_rate=0.01),
            prior=GPPrior(scale=1e-3),
        ),
        0.0,
        30,
    ),
}


@pytest.mark.parametrize("name", METHODS)
def test_a_group_never_seen_is_predicted_from_the_population(name: str) -> None:
    """Within a factor of 1.5 of the planted spread, and 90 % intervals hold 90 % of the population, over several data sets."""
    method, kappa, steps = METHODS[name]
    setting = setting_of(prior_of(gap=kappa > 0))
    x = jnp.asarray(np.concatenate([rows_of(GROUPS, 2), rows_of(3, 2)]))
    copies = jnp.asarray(np.tile(rows_of(GROUPS, 2), (method.particles, 1, 1)))

    @jax.jit
    def fitted(problem: Problem) -> tuple[jax.Array, jax.Array]:
        rule = method.bind(setting, problem)
        state = run(rule, steps)
        return rule.predict(state, x).particles, rule.members(state, copies)

    held, spreads = [], []
    for seed in range(6):
        values = drawn_values(seed)
        particles, alone = (np.asarray(a)[..., 0] for a in fitted(problem_of(values, seed, kappa=kappa)))
        other, known = particles[:, 0], particles[:, 2]
        np.testing.assert_allclose(other.mean(), MIDDLE, atol=0.6)
        np.testing.assert_allclose(known.mean(), values[3], atol=4 * NOISE / np.sqrt(ROWS))
        assert known.std() < 3 * NOISE / np.sqrt(ROWS)
        np.testing.assert_allclose(alone[:, 0], other, atol=1e-6)
        low, high = np.quantile(other, [0.05, 0.95])
        held.append(norm.cdf(high, MIDDLE, SPREAD) - norm.cdf(low, MIDDLE, SPREAD))
        spreads.append((high - low) / (2 * norm.ppf(0.95)))
    assert np.all(np.abs(np.log(np.array(spreads) / SPREAD)) < np.log(1.5)), spreads
    assert 0.83 < np.mean(held) < 0.96, held


def test_a_factor_is_learned_as_well() -> None:
    values = MIDDLE * np.exp(0.3 * np.random.default_rng(3).normal(size=GROUPS))
    found = spread_found(problem_of(values, 1), prior_of(RATIO, Quantity("c", "1", 0.01, 20.0)))
    assert found == pytest.approx(np.log(values).std(ddof=1), rel=0.05)
