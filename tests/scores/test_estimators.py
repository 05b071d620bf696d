"""Estimators that see more than two moments, against exact scores and against plain linear algebra."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from simpel_cli.errors import ConfigError
from simpel_cli.scores import radial
from simpel_cli.scores.estimator import fitted
from simpel_cli.scores.gaussian import Gaussian
from simpel_cli.scores.kde import KDE
from simpel_cli.scores.nu_method import NuMethod, field
from simpel_cli.scores.ssge import SSGE
from tests.score_targets import covariance_of, target

NUMBER_OF_POINTS = 50
ESTIMATORS: dict[str, Any] = {"gaussian": Gaussian(), "kde": KDE(), "ssge": SSGE(), "nu_method": NuMethod()}


def error(estimator: Any, name: str, m: int, n: int, seed: int = 0) -> float:
    """Root mean square error of a score over that of the score itself, at draws of the target."""
    draw, score = target(name, m, seed)
    samples, h = draw(n), draw(NUMBER_OF_POINTS)
    found = estimator(
        jnp.asarray(h, jnp.float32), jnp.asarray(samples, jnp.float32), jnp.asarray(1e-6 * np.eye(m), jnp.float32)
    )
    assert found.dtype == jnp.float32
    exact = score(h)
    return float(np.sqrt(np.mean((np.asarray(found) - exact) ** 2) / np.mean(exact**2)))


# about a quarter above what was measured
@pytest.mark.parametrize(
    ("name", "target_name", "m", "most"),
    [
        ("kde", "gaussian", 2, 0.2), ("kde", "mixture", 2, 0.5), ("kde", "skewed", 2, 0.55),
        ("ssge", "gaussian", 2, 0.2), ("ssge", "mixture", 2, 0.3), ("ssge", "skewed", 2, 0.45),
        ("ssge", "gaussian", 40, 0.3), ("ssge", "mixture", 40, 0.3),
        ("nu_method", "mixture", 2, 0.45), ("nu_method", "skewed", 2, 0.5), ("nu_method", "mixture", 40, 0.45),
    ],
)  # fmt: skip
def test_errors_against_exact_scores(name: str, target_name: str, m: int, most: float) -> None:
    assert error(ESTIMATORS[name], target_name, m, 1028) < most


@pytest.mark.parametrize("name", ["kde", "ssge", "nu_method"])
@pytest.mark.parametrize("target_name", ["mixture", "skewed"])
def test_in_few_dimensions_they_see_more_than_the_gaussian_and_more_with_more_draws(
    name: str, target_name: str
) -> None:
    few, many = (np.mean([error(ESTIMATORS[name], target_name, 2, n, seed) for seed in range(5)]) for n in (64, 1028))
    assert many < 0.9 * few
    assert many < 0.8 * error(Gaussian(), target_name, 2, 1028)


def test_kde_of_two_parameter_values_and_a_gaussian_process_is_their_mixture() -> None:
    m = 12
    covariance = covariance_of(m)
    centres = np.stack([np.sin(np.arange(m)), np.cos(np.arange(m)) - 1])
    h = np.random.default_rng(0).normal(size=(20, m)) @ np.linalg.cholesky(covariance).T + centres[[0, 1] * 10]
    found = KDE(bandwidth=1e-4)(jnp.asarray(h), jnp.asarray(np.repeat(centres, 8, axis=0)), jnp.asarray(covariance))
    np.testing.assert_allclose(found, oracles.mixture_score(h, centres, covariance), rtol=1e-5, atol=1e-5)


def test_kde_as_wide_as_the_prior_is_the_gaussian() -> None:
    draw, _ = target("skewed", 6)
    samples, h, covariance = jnp.asarray(draw(100)), jnp.asarray(draw(9)), jnp.asarray(0.2 * covariance_of(6))
    np.testing.assert_allclose(KDE(1.0)(h, samples, covariance), Gaussian()(h, samples, covariance), rtol=1e-9)


def test_kde_keeps_mean_and_covariance_of_the_prior_whatever_its_width() -> None:
    """A density p has E[s h'] = -I and E[s] = 0 under itself; a mixture without shrinkage would be too wide."""
    draw, _ = target("skewed", 2)
    samples, covariance = draw(60), 0.1 * covariance_of(2)
    spread = np.cov(samples, rowvar=False)
    random = np.random.default_rng(1)
    b = 0.6
    centres = samples.mean(axis=0) + np.sqrt(1 - b**2) * (samples - samples.mean(axis=0))
    noise = random.normal(size=(200_000, 2)) @ np.linalg.cholesky(b**2 * spread + covariance).T
    of_estimate = centres[random.integers(0, 60, 200_000)] + noise
    np.testing.assert_allclose(np.cov(of_estimate, rowvar=False), spread + covariance, rtol=0.03, atol=0.006)
    score = np.asarray(KDE(b)(jnp.asarray(of_estimate), jnp.asarray(samples), jnp.asarray(covariance)))
    np.testing.assert_allclose(score.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(score.T @ of_estimate / len(score), -np.eye(2), atol=0.02)


def test_the_spectral_estimator_is_shi_suns_and_zhus() -> None:
    """Every eigenfunction, dense: eqs. 10 and 14 with K^-1 in place of the truncated spectrum."""
    random = np.random.default_rng(0)
    x, h, s = random.normal(size=(14, 2)), random.normal(size=(5, 2)), 1.3
    estimator = SSGE("squared_exponential", s, share=1.0, rank=14, landmarks=14, eta=0.0, baseline="none")
    found = estimator(jnp.asarray(h), jnp.asarray(x), jnp.zeros((2, 2)))

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-((a[:, None] - b[None]) ** 2).sum(axis=-1) / (2 * s**2))

    values, vectors = np.linalg.eigh(k(x, x))
    psi = np.sqrt(14) * k(h, x) @ vectors / values
    # d/dx_n k(x_n, x_m) = -(x_n - x_m)/s^2 k
    slope = -(x[:, None] - x[None]) / s**2 * k(x, x)[..., None]
    beta = -np.einsum("nmd,mj->jd", slope, np.sqrt(14) * vectors / values) / 14
    np.testing.assert_allclose(found, psi @ beta, rtol=1e-4, atol=1e-6)


def curl_free(x: np.ndarray, y: np.ndarray, s: float) -> np.ndarray:
    """The curl-free kernel of exp(-|x-y|^2/(2 s^2)) by hand, times s^2: (I - d d'/s^2) k."""
    d = (x - y) / s
    return np.asarray((np.eye(len(x)) - np.outer(d, d)) * np.exp(-d @ d / 2))


def dense(x: np.ndarray, y: np.ndarray, s: float) -> np.ndarray:
    """Block matrix of it."""
    return np.block([[curl_free(a, b, s) for b in y] for a in x])


def zeta_of(h: np.ndarray, x: np.ndarray, s: float) -> np.ndarray:
    """Mean over x of the divergence of the kernel in x, by differences."""
    step, (n, m) = 1e-5, x.shape
    found = np.zeros_like(h)
    for i, point in enumerate(h):
        for other in x:
            for j in range(m):
                e = step * np.eye(m)[j]
                found[i] += (curl_free(other + e, point, s)[j] - curl_free(other - e, point, s)[j]) / (2 * step) / n
    return found


@pytest.mark.parametrize("baseline", ["none", "gaussian"])
def test_tikhonovs_variant_solves_the_dense_equations(baseline: str) -> None:
    random = np.random.default_rng(0)
    x, h, s, weight = random.normal(size=(9, 2)), random.normal(size=(4, 2)), 1.4, 0.05
    estimator = NuMethod("squared_exponential", s, regularisation="tikhonov", weight=weight, baseline=baseline)
    found = estimator(jnp.asarray(h), jnp.asarray(x), jnp.zeros((2, 2)))
    score = Gaussian()(jnp.asarray(np.concatenate([x, h])), jnp.asarray(x), jnp.zeros((2, 2)))
    base = np.asarray(score) * (baseline == "gaussian")
    # (L + weight) d = -(zeta + L s_0), in the span of zeta and the kernels at x; lengths in units of s
    c = np.linalg.solve(
        dense(x, x, s) + 9 * weight * np.eye(18), (s * zeta_of(x, x, s) / weight - s * base[:9]).ravel()
    )
    d = -s * zeta_of(h, x, s) / weight + (dense(h, x, s) @ c).reshape(4, 2)
    np.testing.assert_allclose(found, base[9:] + d / s, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("nu", [1.0, 2.0])
def test_the_nu_method_takes_its_steps_on_the_field_itself(nu: float) -> None:
    """The same recursion on values at the draws and at h, with the dense operator; Engl, Hanke, Neubauer (1996), eq. 6.63."""
    random = np.random.default_rng(0)
    x, h, s = random.normal(size=(9, 2)), random.normal(size=(4, 2)), 1.4
    estimator = NuMethod("squared_exponential", s, weight=0.01, nu=nu, baseline="none")
    everywhere = np.concatenate([x, h])
    operator, zeta = dense(everywhere, x, s) / 9, s * zeta_of(everywhere, x, s).ravel()
    before = now = np.zeros(26)
    for t in range(1, estimator.steps + 1):
        u = (
            (t - 1)
            * (2 * t - 3)
            * (2 * t + 2 * nu - 1)
            / ((t + 2 * nu - 1) * (2 * t + 4 * nu - 1) * (2 * t + 2 * nu - 3))
        )
        w = 4 * (2 * t + 2 * nu - 1) * (t + nu - 1) / ((t + 2 * nu - 1) * (2 * t + 4 * nu - 1))
        now, before = now + u * (now - before) - w * (zeta + operator @ now[:18]), now
    found = estimator(jnp.asarray(h), jnp.asarray(x), jnp.zeros((2, 2)))
    np.testing.assert_allclose(found, now[18:].reshape(4, 2) / s, rtol=1e-6, atol=1e-6)
    assert estimator.steps == 11


def test_more_steps_of_the_nu_method_go_where_less_of_tikhonovs_weight_goes() -> None:
    random = np.random.default_rng(0)
    x, h = jnp.asarray(random.normal(size=(40, 2))), jnp.asarray(random.normal(size=(20, 2)))

    def of(**options: Any) -> np.ndarray:
        return np.asarray(NuMethod("squared_exponential", 1.5, baseline="none", **options)(h, x, jnp.zeros((2, 2))))

    exact = of(regularisation="tikhonov", weight=1e-3)
    apart = [np.linalg.norm(of(weight=w) - exact) for w in (1.0, 1e-1, 1e-2)]
    assert apart[0] > apart[1] > apart[2]


def test_curl_free_fields_have_no_curl() -> None:
    random = np.random.default_rng(0)
    x, c = jnp.asarray(random.normal(size=(6, 3))), jnp.asarray(random.normal(size=(6, 3)))
    for kernel in radial.KERNELS:
        jacobian = jax.jacfwd(lambda z, kernel=kernel: field(kernel, z[None], x).apply(c)[0])(
            jnp.asarray([0.3, -0.2, 0.7])
        )
        np.testing.assert_allclose(jacobian, jacobian.T, atol=1e-12)


@pytest.mark.parametrize("kernel", radial.KERNELS)
def test_profiles_are_derivatives_of_each_other(kernel: str) -> None:
    q = jnp.linspace(0.1, 5, 7)
    f = radial.profile(kernel, q)
    for k, (low, high) in enumerate([("f", "f1"), ("f1", "f2"), ("f2", "f3")]):
        slope = jax.vmap(jax.grad(lambda t, low=low: getattr(radial.profile(kernel, t[None]), low)[0]))(q)
        np.testing.assert_allclose(slope, getattr(f, high), rtol=1e-10, err_msg=f"{k}")


@pytest.mark.parametrize("name", ["ssge", "nu_method"])
def test_a_turned_stretched_and_shifted_prior_has_the_score_turned_and_stretched(name: str) -> None:
    draw, _ = target("mixture", 4)
    samples, h = draw(200), draw(9)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))[0]
    nothing = 1e-9 * np.eye(4)
    before = ESTIMATORS[name](jnp.asarray(h), jnp.asarray(samples), jnp.asarray(nothing))
    after = ESTIMATORS[name](
        jnp.asarray(3 * h @ turn.T + 1), jnp.asarray(3 * samples @ turn.T + 1), jnp.asarray(9 * nothing)
    )
    np.testing.assert_allclose(after, before @ turn.T / 3, rtol=1e-3, atol=1e-4)


def test_kde_is_affinely_equivariant() -> None:
    draw, _ = target("mixture", 4)
    samples, h, known = draw(50), draw(9), 0.1 * np.eye(4)
    a = np.random.default_rng(3).normal(size=(4, 4))
    before = KDE()(jnp.asarray(h), jnp.asarray(samples), jnp.asarray(known))
    after = KDE()(jnp.asarray(h @ a.T - 2), jnp.asarray(samples @ a.T - 2), jnp.asarray(a @ known @ a.T))
    np.testing.assert_allclose(after, np.linalg.solve(a.T, before.T).T, rtol=1e-6)


@pytest.mark.parametrize(("name", "most"), [("ssge", 0.25), ("nu_method", 0.45)])
def test_draws_of_the_gaussian_part_and_its_covariance_are_one_law(name: str, most: float) -> None:
    """Simulator draws that do not spread, plus a Gaussian process: the score is the process's own."""
    m, random = 6, np.random.default_rng(0)
    covariance = covariance_of(m)
    root = np.linalg.cholesky(covariance)
    gap, h = random.normal(size=(1028, m)) @ root.T, random.normal(size=(20, m)) @ root.T
    found = ESTIMATORS[name](jnp.asarray(h + 2), jnp.full((1028, m), 2.0), jnp.asarray(covariance), jnp.asarray(gap))
    exact = oracles.gaussian_score(h, np.zeros(m), covariance)
    assert np.linalg.norm(found - exact) < most * np.linalg.norm(exact)
    if name == "ssge":
        alone = SSGE(baseline="none")(
            jnp.asarray(h + 2), jnp.full((1028, m), 2.0), jnp.asarray(covariance), jnp.asarray(gap)
        )
        assert np.linalg.norm(found - exact) < 0.5 * np.linalg.norm(alone - exact)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: KDE("wide"), "score.bandwidth"), (lambda: KDE(1.5), "score.bandwidth"),
        (lambda: SSGE(kernel="box"), "score.kernel"), (lambda: SSGE(bandwidth=0.0), "score.bandwidth"),
        (lambda: SSGE(share=0.0), "score.share"), (lambda: SSGE(rank=0), "score.rank"), (lambda: SSGE(eta=-1.0), "score.eta"),
        (lambda: SSGE(baseline="x"), "score.baseline"), (lambda: NuMethod(weight=0.0), "score.weight"),
        (lambda: NuMethod(regularisation="x"), "score.regularisation"), (lambda: NuMethod(centres=1), "score.centres"),
        (lambda: NuMethod(baseline="x"), "score.baseline"),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()


class Halved(Gaussian):
    """A user's, that changes what another says."""

    def __call__(self, *given: Any) -> Any:
        return super().__call__(*given) / 2


class Bare(Gaussian):
    """A user's, that returns something which cannot be stacked."""

    def fitted(self, *given: Any) -> Any:
        return lambda h: -h


def test_a_users_estimator_that_extends_another_is_called_and_one_that_cannot_be_stacked_is_named() -> None:
    h, samples = jnp.ones((5, 3)), jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)))
    whole = Gaussian()(h, samples, jnp.eye(3))
    np.testing.assert_array_equal(fitted(Halved(), samples, jnp.eye(3), None)(h), whole / 2)
    np.testing.assert_array_equal(fitted(Gaussian(), samples, jnp.eye(3), None)(h), whole)
    with pytest.raises(ConfigError, match=r"Bare\.fitted returned a function; it must return a jax"):
        fitted(Bare(), samples, jnp.eye(3), None)


def test_an_estimator_of_a_users_that_can_only_be_called_is_asked_with_the_draws_it_was_fitted_to() -> None:
    def own(h: Any, samples: Any, covariance: Any, gap: Any) -> Any:
        return -h / (jnp.var(samples, axis=0) + jnp.diag(covariance) + jnp.var(gap, axis=0))[None]

    random = np.random.default_rng(0)
    h, samples, gap = (jnp.asarray(random.normal(size=(n, 3))) for n in (5, 20, 20))
    every = jax.vmap(lambda s, g: fitted(own, s, jnp.eye(3), g))(samples[None], gap[None])
    np.testing.assert_array_equal(jax.tree.map(lambda a: a[0], every)(h), own(h, samples, jnp.eye(3), gap))
