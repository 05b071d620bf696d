"""Lengthscales per input by marginal likelihood, against finite differences and planted functions."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.priors import lengthscales
from simpel_cli.priors.function_prior import FunctionPrior, GapGP
from simpel_cli.priors.gaussian_process import Kernel, Matern32, Matern52, SquaredExponential, gram
from simpel_cli.priors.lengthscales import most_likely

DECLARED = np.full(3, 0.5 / 3**0.5)


def planted(rows: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Inputs, and a function that varies fast with the first, slowly with the second, and not at all with the third."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1.7, 1.7, (rows, 3))
    return x, np.sin(4 * x[:, 0]) + 0.4 * x[:, 1] + 0.02 * random.normal(size=rows)


def found(x: np.ndarray, y: np.ndarray, kernel: Kernel = SquaredExponential(), **given: Any) -> np.ndarray:
    none = np.zeros((2, len(x)))
    return 1 / most_likely(kernel, x, none, y, np.full(len(x), 1e-6), DECLARED, 0.05, **given)


def test_the_input_that_matters_has_the_shortest_lengthscale() -> None:
    fast, slow, none = found(*planted(80))
    assert 0.2 < fast < 1.0
    assert slow > 3 * fast
    assert none > 3 * fast


@pytest.mark.parametrize("kernel", [SquaredExponential(), Matern32(), Matern52()])
@pytest.mark.parametrize("gap", [None, 0.7])
def test_the_gradient_is_that_of_finite_differences(kernel: Kernel, gap: float | None, monkeypatch: Any) -> None:
    x, y = planted(15)
    seen = []

    def looked(objective: Any, start: np.ndarray, **options: Any) -> Any:
        at = start + 0.1 * np.arange(len(start))  # beyond bounds, too
        step = 1e-5 * np.eye(len(at))
        seen.append((objective(at)[1], [(objective(at + s)[0] - objective(at - s)[0]) / 2e-5 for s in step]))
        return original(objective, start, **options)

    original = lengthscales.minimize
    monkeypatch.setattr(lengthscales, "minimize", looked)
    random = np.random.default_rng(1)
    samples, weights = random.normal(size=(9, 1)) * x[:, 1], random.uniform(0.3, 1, 15)
    most_likely(kernel, x, samples, y, np.full(15, 1e-4), DECLARED, 0.05, gap, weights)
    assert len(seen) == 6
    for own, differences in seen:
        np.testing.assert_allclose(own, differences, rtol=1e-5, atol=1e-5)


def test_few_data_leave_them_where_they_are_declared() -> None:
    np.testing.assert_allclose(found(*planted(3)) * DECLARED, 1)


@pytest.mark.parametrize("size", [6, 12])
def test_noise_alone_leaves_them_where_they_are_declared(size: int) -> None:
    """A gap that is white noise explains noise as well as the noise does."""
    declared = np.full(size, 0.5 / size**0.5)
    for seed in range(4):
        random = np.random.default_rng(seed)
        x, y = random.uniform(-1.7, 1.7, (150, size)), 0.1 * random.normal(size=150)
        given = SquaredExponential(), x, np.zeros((2, 150)), y, np.full(150, 1e-6), declared, 0.1
        np.testing.assert_array_equal(most_likely(*given), declared)


def test_a_row_that_hardly_counts_does_not_bend_the_gap() -> None:
    x, y = planted(60)
    weights = np.ones(60)
    weights[7] = 1e-6
    far = y.copy()
    far[7] += 30.0
    np.testing.assert_allclose(found(x, far, weights=weights), found(x, y, weights=weights), rtol=0.05)
    assert not np.allclose(found(x, far), found(x, y), rtol=0.3)


def test_of_many_rows_some_are_looked_at_evenly(monkeypatch: Any) -> None:
    x, y = planted(500)
    monkeypatch.setattr(lengthscales, "MOST_ROWS", 50)
    rows = np.unique(np.linspace(0, 499, 50).round().astype(int))
    np.testing.assert_allclose(found(x, y), found(x[rows], y[rows]), rtol=1e-9)


def test_every_output_has_its_own_correlation() -> None:
    prior = FunctionPrior(2, 1e-4, SquaredExponential(), np.full(2, 0.5), (), None, 0, 2)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(5, 2)))
    relevance = np.array([[1.0, 0.1], [0.2, 3.0]])
    covariance = np.asarray(prior.covariance(x, np.array([0.5, 2.0]), relevance))
    for i, kappa in enumerate((0.5, 2.0)):
        own = gram(SquaredExponential(), *2 * [jnp.asarray(np.asarray(x) * relevance[i])])
        np.testing.assert_allclose(covariance[i], kappa**2 * np.asarray(own) + 1e-4 * np.eye(5), rtol=1e-6)
    same = prior.covariance(x, np.array([0.5, 2.0]), np.full((2, 2), 0.5))
    np.testing.assert_allclose(prior.covariance(x, np.array([0.5, 2.0])), same, rtol=1e-6)


def test_what_is_no_lengthscale_is_refused_with_what_is_allowed() -> None:
    from simpel_cli.errors import ConfigError

    assert GapGP(lengthscale="auto").learns_lengthscales
    with pytest.raises(
        ConfigError, match=r"prior\.gap\.lengthscale: got 'long'; allowed are auto, null and a positive number"
    ):
        GapGP(lengthscale="long")
    with pytest.raises(ConfigError, match=r"prior\.gap\.lengthscale: got -1"):
        GapGP(lengthscale=-1.0)
