"""Methods beside FSVGD against closed forms: linear regression, exact Gaussian processes, known targets."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest

from simpel_cli.errors import ConfigError
from simpel_cli.inference import loop
from simpel_cli.inference.networks import MLP
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Inference, Normaliser, Problem, Setting, pad_rows, padded_length
from simpel_cli.methods.exact_gp import ExactGP
from simpel_cli.methods.fmap import FunctionMAP
from simpel_cli.methods.fsvgd import FSVGD, stein_velocity
from simpel_cli.methods.greybox import GreyBox
from simpel_cli.methods.pathwise import Pathwise
from simpel_cli.methods.preconditioner import basis, preconditioned
from simpel_cli.methods.repulsive import Repulsive
from simpel_cli.methods.svgd import SVGD
from simpel_cli.methods.sysid import SysID
from simpel_cli.priors.function_prior import FunctionPrior, GPPrior
from simpel_cli.scores.gaussian import Gaussian
from simulators.model import Quantity

NOISE, N, EDGE = 0.1, 24, 2.0
RANDOM = np.random.default_rng(0)
X = RANDOM.uniform(-EDGE, EDGE, (N, 1))
FIXED = NoiseModel(learn=False)
PARAMS = (Quantity("a", "", -3.0, 3.0), Quantity("b", "", -1.0, 1.0, prior="normal"))
GRID = np.linspace(-EDGE, EDGE, 21)[:, None]
SMALL: dict[str, Any] = {"network": MLP((8,)), "particles": 3, "batch": 4}
FEW: dict[str, Any] = SMALL | {"fresh_points": 4, "pool": 8}


def line(x: jax.Array, phi: jax.Array) -> jax.Array:
    """A simulator that is linear in its parameters, for one point."""
    return phi[:1] * x + phi[1:]


def prior_of(gap: bool = False, params: tuple[Quantity, ...] = PARAMS) -> FunctionPrior:
    kernel = GPPrior().kernel if gap else None
    return FunctionPrior(64, 1e-8, kernel, np.ones(1), params, line, 1, 1)


def problem_of(y: np.ndarray, kappa: float = 0.0, x: np.ndarray = X) -> Problem:
    one, length = np.ones(1), padded_length(len(x))
    return jax.tree.map(
        jnp.asarray,
        Problem(
            x=pad_rows(x, length), y=pad_rows(y, length), m=np.array(len(x), np.int32),
            normaliser=Normaliser(0 * one, one, 0 * one, one), gap_scale=kappa * one, noise_init=NOISE * one,
            noise_floor=0.01 * NOISE * one,
        ),
    )  # fmt: skip


def setting_of(prior: FunctionPrior) -> Setting:
    return Setting(prior, Gaussian(), lambda key, n: jax.random.uniform(key, (n, 1), minval=-EDGE, maxval=EDGE))


def run(rule: Inference, steps: int, seed: int = 0) -> Any:
    key = jax.random.key(seed)
    state = rule.init(key)
    draws = rule.draw(jax.random.fold_in(key, 1), state)

    def body(i: Any, state: Any) -> Any:
        return rule.step(jax.random.fold_in(key, i), state, draws)[0]

    return jax.jit(lambda state: jax.lax.fori_loop(0, steps, body, state))(state)


def predicted(method: Any, y: np.ndarray, prior: FunctionPrior, kappa: float = 0.0) -> Predictive:
    rule = method.bind(setting_of(prior), problem_of(y, kappa))
    return rule.predict(run(rule, method.steps), jnp.asarray(GRID))


def test_sysid_is_bayesian_linear_regression() -> None:
    """Uniform a, normal b: the posterior of a line with known noise; Bishop (2006), eqs. 3.50-3.51."""
    y = 1.3 * X - 0.4 + NOISE * RANDOM.normal(size=X.shape)
    found = predicted(SysID(particles=4000, noise=FIXED), y, prior_of())
    design = np.concatenate([X, np.ones_like(X)], axis=1)
    precision = design.T @ design / NOISE**2 + np.diag([12 / 6**2, 1 / 0.5**2])
    mean = np.linalg.solve(design.T @ design / NOISE**2 + np.diag([0, 1 / 0.5**2]), design.T @ y / NOISE**2)
    grid = np.concatenate([GRID, np.ones_like(GRID)], axis=1)
    np.testing.assert_allclose(found.mean, grid @ mean, atol=1e-4)
    exact = np.sqrt(np.einsum("ni,ij,nj->n", grid, np.linalg.inv(precision), grid))
    np.testing.assert_allclose(found.epistemic_std[:, 0], exact, rtol=0.05)
    np.testing.assert_allclose(found.noise_std, NOISE)


def test_sysid_stays_within_its_ranges_and_calls_the_rest_noise() -> None:
    y = 5.0 * X  # a is at most 3
    found = predicted(SysID(), y, prior_of())
    slope = np.asarray((found.particles[:, -1] - found.particles[:, 0])[:, 0]) / (2 * EDGE)
    assert slope.max() <= 3 + 1e-9
    assert slope.mean() > 2.9
    left = np.std(y - 3.0 * X)
    np.testing.assert_allclose(found.noise_std[0], left, rtol=0.3)


def test_sysid_finds_the_better_of_two_valleys_from_several_starts() -> None:
    """sin(a x): a single start from the middle ends in the wrong valley."""

    def wave(x: jax.Array, phi: jax.Array) -> jax.Array:
        return jnp.sin(phi[:1] * x) + 0 * phi[1:]

    prior = prior_of(params=(Quantity("a", "", 0.5, 6.0), Quantity("b", "", -1.0, 1.0)))._replace(step=wave)
    y = np.sin(5.2 * X) + 0.02 * RANDOM.normal(size=X.shape)
    many = predicted(SysID(starts=16), y, prior)
    np.testing.assert_allclose(many.mean[:, 0], np.sin(5.2 * GRID[:, 0]), atol=0.1)
    assert float(many.noise_std[0]) < 0.06


def test_sysid_follows_a_curved_valley_to_its_end() -> None:
    """f = a x + (b - 3 a^2): steps are refused again and again on the way, which is no sign of the end."""

    def curved(x: jax.Array, phi: jax.Array) -> jax.Array:
        return phi[:1] * x * 0.1 + (phi[1:] - 3 * phi[:1] ** 2)

    params = (Quantity("a", "", -1.0, 1.0), Quantity("b", "", -6.0, 6.0))
    y = np.asarray(0.8 * X * 0.1 + (2.5 - 3 * 0.8**2))
    prior = prior_of(params=params)._replace(step=curved)
    rule = SysID(starts=1, noise=FIXED).bind(setting_of(prior), problem_of(y))
    for seed in range(3):
        end = run(rule, 200, seed)
        phi = np.asarray([-1.0, -6.0]) + np.asarray([2.0, 12.0]) * np.asarray(end.u[0])
        np.testing.assert_allclose(phi, [0.8, 2.5], atol=2e-3)


def test_sysid_rests_where_every_start_has_ended() -> None:
    """An ended search is left as it is, whatever the number of steps, one problem at a time or several."""
    problems = [problem_of(slope * X) for slope in (0.5, -1.2)]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    setting = setting_of(prior_of())

    def ended(problem: Problem, steps: int) -> Any:
        return run(SysID(noise=FIXED).bind(setting, problem), steps).u

    together = jax.vmap(lambda problem: ended(problem, 60))(both)
    for one, mine in zip(problems, together, strict=True):
        np.testing.assert_array_equal(ended(one, 60), ended(one, 90))
        np.testing.assert_allclose(mine, ended(one, 60), atol=1e-6)


def test_a_wide_simulator_a_few_draws_at_a_time_is_the_same_simulator() -> None:
    """Draws, and the search for parameters, whatever the number of transitions that fit the cache."""
    prior = prior_of()
    key, x = jax.random.key(3), jnp.asarray(X)
    wide = prior._replace(width=5000)
    np.testing.assert_allclose(wide.simulate(key, x, 37), prior.simulate(key, x, 37), rtol=1e-12)
    y = 1.3 * X - 0.4
    one, other = (run(SysID(noise=FIXED).bind(setting_of(p), problem_of(y)), 40).u for p in (prior, wide))
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    "method", [ExactGP(SysID(noise=FIXED)), FSVGD(steps=20, **FEW), Pathwise(steps=20, **SMALL, features=50)]
)
def test_lengthscales_of_the_problem_stand_in_place_of_those_of_the_prior(method: Any) -> None:
    """The same posterior as under a prior that declares them, and another one than under the prior's own."""
    prior = prior_of(gap=True)._replace(draws=200)
    problem = problem_of(1.3 * X - 0.4 + 0.5 * np.sin(3 * X), kappa=0.5)

    def mean(prior: FunctionPrior, relevance: float | None) -> np.ndarray:
        own = problem if relevance is None else problem._replace(gap_relevance=jnp.array([[relevance]]))
        rule = method.bind(setting_of(prior), own)
        return np.asarray(rule.predict(run(rule, method.steps), jnp.asarray(GRID)).mean)

    declared = mean(prior._replace(input_scale=np.array([3.0])), None)
    np.testing.assert_allclose(mean(prior, 3.0), declared, rtol=1e-4, atol=1e-5)
    assert not np.allclose(mean(prior, None), declared, rtol=1e-3, atol=1e-4)


def test_the_residual_of_greybox_has_the_lengthscale_of_its_own_prior() -> None:
    """What was chosen for the simulator's gap is not for what an identified simulator leaves."""
    method = GreyBox(SysID(steps=20, noise=FIXED), FSVGD(steps=10, **FEW), GPPrior(lengthscale=0.7))
    problem = problem_of(1.3 * X - 0.4 + 0.5 * np.sin(3 * X))
    plain, chosen = (
        method.bind(setting_of(prior_of()), p) for p in (problem, problem._replace(gap_relevance=jnp.array([[9.0]])))
    )
    found = [rule.predict(run(rule, 10), jnp.asarray(GRID)).mean for rule in (plain, chosen)]
    np.testing.assert_array_equal(*found)


def test_exact_gp_is_the_textbook_posterior_about_the_identified_line() -> None:
    y = 1.3 * X - 0.4 + 0.5 * np.sin(3 * X) + NOISE * RANDOM.normal(size=X.shape)
    method = ExactGP(sysid=SysID(noise=FIXED), particles=50)
    found = predicted(method, y, prior_of(gap=True), kappa=0.5)
    line_alone = predicted(SysID(noise=FIXED, particles=1), y, prior_of())
    rule = SysID(noise=FIXED, particles=1).bind(setting_of(prior_of()), problem_of(y))
    at_data = rule.predict(run(rule, 200), jnp.asarray(X)).mean[:, 0]

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return 0.25 * oracles.squared_exponential(a[:, 0], b[:, 0], 1.0)

    mean, covariance = oracles.gp_posterior(k(X, X), k(GRID, X), k(GRID, GRID), y[:, 0] - np.asarray(at_data), NOISE)
    np.testing.assert_allclose(found.mean[:, 0], np.asarray(line_alone.mean[:, 0]) + mean, atol=1e-4)
    np.testing.assert_allclose(found.epistemic_std[:, 0], np.sqrt(np.diag(covariance)), rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_preconditioner_is_the_inverse_curvature_of_data_spread_evenly(weight: float) -> None:
    random = np.random.default_rng(2)
    factor = random.normal(size=(2, 6, 6))
    prior, evenly = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(6), np.array([0.3, 2.0])
    velocity = random.normal(size=(3, 6, 2))
    own = basis(jnp.asarray(prior), jnp.dtype(jnp.float64))
    found = preconditioned(jnp.asarray(velocity), own, jnp.asarray(evenly), weight)
    for i in range(2):
        curvature = weight * np.linalg.inv(prior[i]) + np.eye(6) / evenly[i]
        np.testing.assert_allclose(found[:, :, i], np.linalg.solve(curvature, velocity[:, :, i].T).T, rtol=1e-9)


@pytest.mark.slow
def test_newtons_direction_reaches_in_few_steps_the_posterior_of_a_line_that_is_nearly_right() -> None:
    y = 1.3 * X - 0.4 + 0.05 * np.sin(3 * X) + NOISE * RANDOM.normal(size=X.shape)
    prior, kappa = prior_of(gap=True), 0.05

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        lines = 3.0 * a @ b.T + 0.25  # variances of U(-3, 3) and N(0, 1/2)
        return lines + kappa**2 * oracles.squared_exponential(a[:, 0], b[:, 0], 1.0)

    exact, _ = oracles.gp_posterior(k(X, X), k(GRID, X), k(GRID, GRID), y[:, 0], NOISE)

    def off(precondition: bool) -> float:
        method = FunctionMAP(
            steps=600, particles=4, network=MLP((32, 32)), pool=64, weight_decay=0.0, noise=FIXED,
            precondition=precondition,
        )  # fmt: skip
        return float(np.sqrt(np.mean((predicted(method, y, prior, kappa).mean[:, 0] - exact) ** 2)))

    assert off(True) < 0.05
    assert off(True) < off(False) / 3


def test_exact_gp_finds_the_noise_by_marginal_likelihood() -> None:
    x = np.linspace(-EDGE, EDGE, 200)[:, None]
    y = np.sin(3 * x) + 0.3 * np.random.default_rng(1).normal(size=x.shape)
    rule = ExactGP().bind(setting_of(prior_of(gap=True)), problem_of(y, 1.0, x))
    found = rule.predict(run(rule, 100), jnp.asarray(GRID))
    np.testing.assert_allclose(found.noise_std[0], 0.3, rtol=0.2)


def test_greybox_learns_what_the_simulator_leaves() -> None:
    y = 1.3 * X - 0.4 + 0.5 * np.sin(3 * X) + 0.02 * RANDOM.normal(size=X.shape)
    net = MLP((32, 32))
    residual = FSVGD(steps=1500, particles=8, network=net, batch=24, fresh_points=8, pool=64, noise=FIXED)
    method = GreyBox(SysID(steps=60, noise=FIXED), residual, GPPrior(lengthscale=0.7))
    found = predicted(method, y, prior_of())
    alone = predicted(SysID(noise=FIXED), y, prior_of())
    truth = 1.3 * GRID - 0.4 + 0.5 * np.sin(3 * GRID)
    inside = np.abs(GRID[:, 0]) < 1.6
    errors = [float(np.sqrt(np.mean((np.asarray(p.mean) - truth)[inside] ** 2))) for p in (found, alone)]
    assert errors[0] < 0.35 * errors[1]


@pytest.mark.parametrize(("learn", "share"), [(True, 1.0), (True, 0.5), (True, 0.0), (False, 1.0)])
def test_the_least_noise_of_greybox_is_what_its_own_prior_leaves_of_the_residual(learn: bool, share: float) -> None:
    """A wave that the simulator lacks is no noise to it; nearly half of the rows are padding."""
    x = np.random.default_rng(3).uniform(-EDGE, EDGE, (70, 1))
    y = 1.3 * x - 0.4 + 0.5 * np.sin(3 * x) + NOISE * np.random.default_rng(4).normal(size=x.shape)
    noise = NoiseModel(learn=learn, marginal_share=share)
    method = GreyBox(SysID(steps=60, noise=FIXED), FSVGD(steps=1, noise=noise, **FEW), GPPrior(lengthscale=0.7))
    problem = problem_of(y, x=x)._replace(noise_init=jnp.ones(1))
    state = method.bind(setting_of(prior_of()), problem).init(jax.random.key(0))
    expected = share * NOISE if learn and share else 0.01 * NOISE
    np.testing.assert_allclose(state.noise_floor, expected, rtol=0.2)
    noise_std = method.residual.noise.std(state.residual.noise, state.noise_floor / state.scale) * state.scale
    np.testing.assert_allclose(noise_std, 1.0, rtol=1e-3)
    np.testing.assert_allclose(state.scale, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("wave", [0.0, 0.02])
def test_the_scale_of_what_greybox_learns_is_what_the_simulator_leaves(wave: float) -> None:
    x = np.random.default_rng(3).uniform(-EDGE, EDGE, (100, 1))
    y = 1.3 * x - 0.4 + wave * np.sin(3 * x) + 0.01 * np.random.default_rng(4).normal(size=x.shape)
    method = GreyBox(
        SysID(steps=60, noise=FIXED), FSVGD(steps=1, **FEW), GPPrior(lengthscale=0.7, scale="auto", white_variance=1e-6)
    )
    rule = method.bind(setting_of(prior_of()), problem_of(y, x=x))
    state = rule.init(jax.random.key(0))
    assert 0.3 * wave <= float(state.scale[0]) <= max(2 * wave, 0.01)
    assert 0.007 < float(state.noise_floor[0]) < 0.014  # that of the problem is 0.001
    _, info = rule.step(jax.random.key(1), state, rule.draw(jax.random.key(2), state))
    np.testing.assert_allclose(info.noise_std, NOISE, rtol=1e-3)  # in the units of the targets
    close = jax.tree.map(lambda a: 0 * a, state.residual.particles)
    nothing = rule.predict(state._replace(residual=state.residual._replace(particles=close)), jnp.asarray(x))
    np.testing.assert_allclose(nothing.noise_std, NOISE, rtol=1e-3)
    assert np.std(np.asarray(nothing.mean) - y) < 0.8 * wave + 0.02  # the identified line alone
    one = rule.predict(state, jnp.asarray(x)).particles - nothing.particles
    assert np.std(np.asarray(one)) < 3 * float(state.scale[0]) + 1e-3


def test_greybox_of_many_rows_looks_at_some_of_all_of_them() -> None:
    """The first half agrees with the simulator, the second has a wave."""
    x = np.random.default_rng(3).uniform(-EDGE, EDGE, (1500, 1))
    wave = np.where(np.arange(1500)[:, None] < 750, 0.0, 0.5 * np.sin(3 * x))
    method = GreyBox(SysID(steps=60, noise=FIXED), FSVGD(steps=1, **FEW), GPPrior(lengthscale=0.7, scale="auto"))
    problem = problem_of(1.3 * x - 0.4 + wave, x=x)
    state = method.bind(setting_of(prior_of()), problem).init(jax.random.key(0))
    np.testing.assert_array_equal(state.noise_floor, problem.noise_floor)
    assert float(state.noise_floor[0]) < 0.05 < float(state.scale[0])


def test_draws_of_parameters_of_which_only_the_product_is_told_stay_on_their_ridge() -> None:
    def product(x: jax.Array, phi: jax.Array) -> jax.Array:
        return phi[:1] * phi[1:] * x

    prior = prior_of(params=(Quantity("a", "", 0.5, 2.0), Quantity("b", "", 0.5, 2.0)))._replace(step=product)
    found = predicted(SysID(particles=500, noise=NoiseModel(learn=False)), 1.2 * X, prior)
    slope = np.asarray((found.particles[:, -1] - found.particles[:, 0])[:, 0]) / (2 * EDGE)
    # the Gaussian is straight, the ridge is bent: a few per cent; draws clipped one by one leave it by ten and more
    assert np.abs(slope - 1.2).mean() < 0.1
    np.testing.assert_allclose(slope.mean(), 1.2, rtol=0.1)


def test_a_method_that_calibrates_asks_for_a_simulator() -> None:
    bound = GPPrior().bind(None, 1, 1, np.ones(1))
    for method in (SysID(), ExactGP(), GreyBox()):
        with pytest.raises(ConfigError, match="prior=simulator"):
            method.bind(setting_of(bound), problem_of(X))
    with pytest.raises(ConfigError, match="gap process"):
        ExactGP().bind(setting_of(prior_of()), problem_of(X))


def flown(velocity: Any, n: int, d: int, steps: int = 4000) -> np.ndarray:
    """Particles of N(1, diag 1..) after gradient steps along a velocity."""
    h = jnp.asarray(np.random.default_rng(0).normal(size=(n, d)) * 0.3)
    rule = optax.adam(optax.exponential_decay(0.05, steps, 0.01))

    def body(_: Any, carry: Any) -> Any:
        h, state = carry
        with jax.numpy_dtype_promotion("standard"):
            updates, state = rule.update(-velocity(h, 1.0 - h), state)
        return h + updates, state

    return np.asarray(jax.jit(lambda h: jax.lax.fori_loop(0, steps, body, (h, rule.init(h)))[0])(h))


def test_the_repulsive_flow_covers_a_gaussian_and_map_collapses_onto_its_mode() -> None:
    found = flown(lambda h, s: Repulsive(bandwidth="median").velocity(h, s)[0], 50, 1)
    np.testing.assert_allclose(found.mean(), 1.0, atol=0.05)
    assert 0.7 < found.std() < 1.1  # the kernel of the density smooths it: particles stand a little too near
    np.testing.assert_allclose(flown(lambda h, s: FunctionMAP().velocity(h, s)[0], 5, 2), 1.0, atol=1e-3)


def test_the_repulsive_velocity_is_the_score_less_the_gradient_of_the_log_density_of_particles() -> None:
    rng = np.random.default_rng(0)
    h, score, width = jnp.asarray(rng.normal(size=(6, 3, 2))), jnp.asarray(rng.normal(size=(6, 3, 2))), 1.7

    def log_density(at: jax.Array) -> jax.Array:
        return jax.scipy.special.logsumexp(-jnp.sum((at[None] - h) ** 2, axis=(1, 2)) / (2 * width**2))

    expected = score - jax.vmap(jax.grad(log_density))(h)
    np.testing.assert_allclose(Repulsive(bandwidth=width).velocity(h, score)[0], expected, rtol=1e-10)


def test_svgd_without_data_is_its_prior() -> None:
    """One row that says nothing: weights and biases keep the spread of their priors."""
    method = SVGD(
        steps=3000, particles=40, network=MLP((2,)), learning_rate=3e-2, bandwidth="median", noise=FIXED, weight_std=0.5
    )
    x = np.zeros((1, 1))
    problem = problem_of(x, x=x)._replace(noise_init=jnp.full(1, 1e3))
    state = run(method.bind(setting_of(prior_of()), problem), method.steps)
    (kernel, bias), *_ = state.particles
    np.testing.assert_allclose(np.asarray(kernel).std(), 0.5, rtol=0.2)
    np.testing.assert_allclose(np.asarray(bias).std(), 1.0, rtol=0.2)


def test_svgd_moves_weights_along_steins_velocity_of_the_log_posterior() -> None:
    y = 1.3 * X
    method = SVGD(steps=1, particles=4, network=MLP((3,)), batch=N, bandwidth=1.5, noise=FIXED)
    problem = problem_of(y)
    rule = method.bind(setting_of(prior_of()), problem)
    state = jax.jit(rule.init)(jax.random.key(0))
    after, info = jax.jit(rule.step)(jax.random.key(1), state, None)
    flat, unflatten = jax.flatten_util.ravel_pytree(jax.tree.map(lambda a: a[0], state.particles))

    def log_posterior(w: jax.Array) -> jax.Array:
        layers = unflatten(w)
        e = (jnp.asarray(y) - method.network.apply(layers, jnp.asarray(X))) / NOISE
        prior = sum(jnp.sum(k**2) / 0.25 + jnp.sum(b**2) for k, b in layers)
        return -0.5 * jnp.sum(e**2) - 0.5 * prior

    every = jnp.stack(
        [jax.flatten_util.ravel_pytree(jax.tree.map(lambda a, i=i: a[i], state.particles))[0] for i in range(4)]
    )
    velocity = stein_velocity(every, jax.vmap(jax.grad(log_posterior))(every), 1.5)[0]
    moved = jnp.stack(
        [jax.flatten_util.ravel_pytree(jax.tree.map(lambda a, i=i: a[i], after.particles))[0] for i in range(4)]
    )
    big = jnp.abs(velocity) > 1e-3
    np.testing.assert_array_equal(
        jnp.sign(moved - every)[big], jnp.sign(velocity)[big]
    )  # Adam's first step is its sign
    assert float(info.loss) > 0
    assert flat.shape == (10,)


def test_a_prior_without_a_simulator_is_centred_on_the_mean_of_the_normaliser() -> None:
    problem = problem_of(X)
    problem = problem._replace(normaliser=problem.normaliser._replace(y_mean=jnp.full(1, 5.0), y_std=jnp.full(1, 2.0)))
    method = FSVGD(particles=2, network=MLP((4,)), batch=8, pool=16, fresh_points=8)
    without = GPPrior().bind(None, 1, 1, np.ones(1))

    def centre(prior: FunctionPrior) -> np.ndarray:
        rule, key = method.bind(setting_of(prior), problem), jax.random.key(0)
        (mean, _) = jax.tree.leaves(rule.draw(key, rule.init(key)).score)
        return np.asarray(mean)

    np.testing.assert_array_equal(centre(without), 0.0)
    np.testing.assert_allclose(np.mean(centre(prior_of())), -2.5, atol=0.3)  # a line through 0 is 5/2 below the mean


@pytest.mark.parametrize("precondition", [False, True])
def test_a_stretch_of_steps_chooses_among_all_its_sets_and_each_has_the_prior_of_its_own_points(
    precondition: bool,
) -> None:
    problem, prior, sets = problem_of(1.3 * X, kappa=0.3), prior_of(gap=True), 9
    method = FSVGD(
        particles=3, network=MLP((8,)), batch=4, fresh_points=4, pool=256, sets=sets, precondition=precondition
    )
    rule = method.bind(setting_of(prior), problem)
    state = rule.init(jax.random.key(1))
    drawn = rule.draw(jax.random.key(0), state)
    assert drawn.x.shape == (sets, 8, 1)
    assert len(np.unique(np.asarray(drawn.x[:, 4:]))) > 4 * 4  # fresh points of every set are its own
    _, precision = jax.tree.leaves(drawn.score)
    for i in range(sets):
        x = np.asarray(drawn.x[i])
        np.testing.assert_allclose(x[:4], X[np.asarray(drawn.batch[i])])
        # a line through 0 with a slope and an offset, and the gap
        law = 3.0 * x @ x.T + 0.25 + 0.3**2 * oracles.squared_exponential(x[:, 0], x[:, 0], 1.0) + 1e-8 * np.eye(8)
        whitened = np.asarray(precision[i, 0]) @ law
        assert np.trace(whitened) / 8 == pytest.approx(1.0, abs=0.25)
        if precondition:
            values, vectors = (np.asarray(a[i, 0]) for a in drawn.basis)
            np.testing.assert_allclose(vectors * values @ vectors.T @ np.asarray(precision[i, 0]), np.eye(8), atol=1e-5)
    assert precondition or drawn.basis is None
    step = jax.jit(lambda key: rule.step(key, state, drawn)[1].loss)
    losses = [float(step(key)) for key in jax.random.split(jax.random.key(2), 60)]
    assert len(set(losses)) == sets


EVERY = {
    "fsvgd": FSVGD(steps=6, **FEW), "map": FunctionMAP(steps=6, **FEW), "repulsive": Repulsive(steps=6, **FEW),
    "svgd": SVGD(steps=6, **SMALL), "sysid": SysID(steps=6, starts=2, particles=3),
    "gp": ExactGP(sysid=SysID(steps=6, starts=2), particles=3),
    "greybox": GreyBox(SysID(steps=6, starts=2), FSVGD(steps=6, **FEW)),
    "pathwise": Pathwise(steps=6, features=16, pool=8, **SMALL),
}  # fmt: skip


# the class of fsvgd, with another velocity; a state of the same arrays, or none that grows
ALIKE = ("map", "repulsive", "svgd", "sysid", "gp")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in ALIKE else []) for n in EVERY])
def test_of_no_data_nothing_is_learned(name: str) -> None:
    """Values in the padding change nothing, and nothing is divided by their number."""
    problem = problem_of(1.3 * X, kappa=0.3)._replace(m=jnp.int32(0))
    setting = setting_of(prior_of(gap=True)._replace(draws=70))

    @jax.jit
    def mean(y: jax.Array) -> jax.Array:
        rule = EVERY[name].bind(setting, problem._replace(y=y))
        return rule.predict(run(rule, 6), jnp.asarray(X)).mean

    found = mean(problem.y)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found, mean(7 - 3 * problem.y))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in ALIKE else []) for n in EVERY])
def test_every_method_goes_on_bit_for_bit_in_float32_with_two_outputs_far_from_zero(name: str) -> None:
    method, seeds = EVERY[name], 2

    def two(x: jax.Array, phi: jax.Array) -> jax.Array:
        return jnp.concatenate([phi[:1] * x + 20.0, phi[1:] * x - 300.0])

    prior = FunctionPrior(70, 1e-4, GPPrior().kernel, np.ones(1), PARAMS, two, 1, 2)
    x = np.repeat(X[None], seeds, axis=0)
    y = np.concatenate([1.3 * X, 0.5 * X], axis=1)[None] + np.zeros((seeds, 1, 1))
    pad = padded_length(N)
    problem = Problem(
        x=np.stack([pad_rows(a, pad) for a in x]), y=np.stack([pad_rows(a, pad) for a in y]), m=np.full(seeds, N, np.int32),
        normaliser=Normaliser(*(np.tile(v, (seeds, 1)) for v in ([0.0], [1.0], [20.0, -300.0], [1.0, 1.0]))),
        gap_scale=np.full((seeds, 2), 0.3), noise_init=np.full((seeds, 2), NOISE), noise_floor=np.full((seeds, 2), 1e-3),
    )  # fmt: skip
    problem = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32 if a.dtype == float else None), problem)
    setting = setting_of(prior)._replace(
        sample_inputs=lambda key, n: jax.random.uniform(key, (n, 1), jnp.float32, -2.0, 2.0)
    )
    keys = jax.random.split(jax.random.key(0), seeds)
    program = loop.compiled(lambda p: method.bind(setting, p), problem, keys, 2)
    whole = [jax.tree.map(np.array, s.state) for s in loop.train(program, 6)]
    # a stretch gives its state's memory to the next one: what is gone on with is a copy
    rest = [s.state for s in loop.train(program, 6, state=jax.tree.map(jnp.asarray, whole[0]), start=2)]
    jax.tree.map(np.testing.assert_array_equal, whole[-1], jax.tree.map(np.array, rest[-1]))
    one = jax.tree.map(lambda a: jnp.asarray(a[0]), (problem, whole[-1]))
    found = method.bind(setting, one[0]).predict(one[1], jnp.asarray(X, jnp.float32))
    assert found.particles.shape == (method.particles, N, 2)
    assert np.isfinite(np.asarray(found.particles)).all()
    assert abs(float(found.mean[:, 0].mean()) - 20.0) < 5
    assert abs(float(found.mean[:, 1].mean()) + 300.0) < 5
    assert found.particles.dtype == jnp.float32


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SysID(starts=0), "method.starts"), (lambda: SVGD(weight_std=0.0), "method.weight_std"),
        (lambda: SVGD(bandwidth="wide"), "method.bandwidth"), (lambda: Repulsive(bandwidth=-1.0), "method.bandwidth"),
        (lambda: ExactGP(particles=1), "method.particles"), (lambda: FunctionMAP(learning_rate=0.0), "method.learning_rate"),
        (lambda: dataclasses.replace(FSVGD(), bandwidth=0.0), "method.bandwidth"),
        (lambda: FSVGD(sets=0), "method.sets"), (lambda: FSVGD(pool=32), r"batch \+ fresh_points \(40\)"),
        (lambda: Repulsive(precondition=True, prior_weight=0.0), "prior_weight"),
        (lambda: MLP(negative_slope=0.2, activation="silu"), "method.network.negative_slope: got 0.2; silu has no slope"),
        (lambda: MLP(activation="relu"), "method.network.activation: got 'relu'; allowed are leaky_relu, silu, tanh"),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(make: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()


def test_many_data_get_more_sets_than_few() -> None:
    """A stretch that chose among the same few batches would not see most of the rows."""

    def count(rows: int) -> int:
        x = np.linspace(-EDGE, EDGE, rows)[:, None]
        method = FSVGD(particles=2, network=MLP((4,)), batch=4, fresh_points=4, pool=16, sets=3)
        rule = method.bind(setting_of(prior_of()), problem_of(x, x=x))
        key = jax.random.key(0)
        return len(jax.eval_shape(lambda: rule.draw(key, rule.init(key))).x)

    assert [count(n) for n in (8, 60, 5000)] == [8, 16, 256]  # rows are padded to 32, 64, 8192
