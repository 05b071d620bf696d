"""Targets at the ends of a sensor: sites against numerical integration, and parameters that clipping does not drag."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from simpel_cli.inference import scales
from simpel_cli.inference.assemble import Assembled, assemble
from simpel_cli.inference.censored import LEAST, propagated, site
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Problem, Training
from simpel_cli.inference.system import normaliser_of, system_of
from simpel_cli.methods.exact_gp import ExactGP
from simpel_cli.methods.sysid import SysID
from simpel_cli.priors.function_prior import GapGP, SimulatorPrior
from simpel_cli.scores.gaussian import Gaussian
from simulators.model import Declared

KEY = jax.random.key(0)
A, B, SIGMA, LOW, HIGH = 2.0, 0.4, 0.4, -2.3, 3.1
SYSTEM = system_of(
    Declared(
        "line", 0.1, inputs={"u": {"unit": "V", "range": [-2, 2]}}, outputs={"y": {"unit": "m", "expression": "a*u + b"}},
        parameters={"a": {"unit": "m/V", "range": [0.5, 4]}, "b": {"unit": "m", "range": [-1, 1]}},
    ).model(),
    ("y",), 0,
)  # fmt: skip
NORMALISER = normaliser_of(SYSTEM, KEY)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("distance", [-40.0, -3.0, -0.5, 0.0, 1.0, 4.0])
def test_one_site_has_the_moments_of_the_integral(side: float, distance: float) -> None:
    """Of a Gaussian times one probit the site is exact."""
    mean, variance, end, sigma = 0.7, 0.3**2, 0.7 - side * distance * 0.5, 0.4
    f = np.linspace(mean - 14 * 0.3, mean + 14 * 0.3, 40001) + side * max(-distance, 0) * 0.18
    log_mass = norm.logpdf(f, mean, 0.3) + norm.logcdf(side * (f - end) / sigma)
    mass = np.exp(log_mass - log_mass.max())
    first = np.sum(mass * f) / np.sum(mass)
    second = np.sum(mass * (f - first) ** 2) / np.sum(mass)
    target, own = site(mean, variance, end, side, sigma)
    precision = 1 / variance + own
    assert (mean / variance + target * own) / precision == pytest.approx(first, abs=2e-6)
    assert 1 / precision == pytest.approx(second, rel=2e-5)


def test_far_within_the_mass_a_row_says_nothing_and_still_counts() -> None:
    target, precision = site(100.0, 1.0, 0.0, 1.0, 0.1)
    assert precision == pytest.approx(LEAST / 0.1**2)
    assert np.isfinite(target)
    target, precision = site(100.0, 1.0, 0.0, -1.0, 0.1)  # 100 above a low end: nearly a value
    assert abs(target) < 0.03
    assert precision == pytest.approx(1 / 0.1**2, rel=0.02)


def test_sites_of_rows_that_depend_on_each_other() -> None:
    mean, covariance = np.array([0.3, -0.2]), np.array([[1.0, 0.7], [0.7, 0.8]])
    end, side, sigma = np.array([0.8, -0.5]), np.array([1.0, -1.0]), 0.3
    axis = np.linspace(-6, 6, 801)
    f = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    mass = multivariate_normal(mean, covariance).pdf(f) * np.prod(norm.cdf(side * (f - end) / sigma), axis=-1)
    mass /= mass.sum()
    exact = np.einsum("ij,ijk->k", mass, f)
    spread = np.einsum("ij,ijk,ijl->kl", mass, f - exact, f - exact)
    found = propagated(mean, covariance, end, side, sigma)
    assert (found.variance > 0).all()
    gain = covariance @ np.linalg.inv(covariance + np.diag(found.variance))
    np.testing.assert_allclose(mean + gain @ (found.target - mean), exact, atol=0.01)
    np.testing.assert_allclose(covariance - gain @ covariance, spread, atol=0.01)


def test_many_rows_at_one_end_settle() -> None:
    """Two unknowns, 100 rows beyond the end: sweeps of all rows at once would overshoot."""
    x = np.random.default_rng(0).uniform(0.5, 2, 100)
    design = np.stack([x, np.ones_like(x)], axis=1)
    covariance = design @ np.diag([1.0, 0.3]) @ design.T + 1e-6 * np.eye(100)
    found = propagated(2 * x + 0.4, covariance, np.full(100, 2.5), np.ones(100), 0.1)
    assert np.isfinite(found.target).all()
    assert (found.variance > 0).all()
    gain = np.linalg.solve(covariance + np.diag(found.variance), covariance)
    after = 2 * x + 0.4 + gain.T @ (found.target - 2 * x - 0.4)
    assert after[np.argmin(x)] > 2.4  # a row at which the prior is below the end is lifted to it


def measured(seed: int, rows: int = 160, nu: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, (rows, 1))
    true = A * u + B + SIGMA * (rng.normal(size=u.shape) if np.isinf(nu) else rng.standard_t(nu, u.shape))
    y = np.clip(true, LOW, HIGH)
    return u, y, np.where(y == HIGH, 1.0, np.where(y == LOW, -1.0, 0.0))


def training(seed: int, kind: str, nu: float = np.inf) -> Training:
    u, y, beyond = measured(seed, nu=nu)
    if kind == "clipped":
        return Training(u, y)
    return Training(u, y, np.ones_like(y), (beyond == 0).astype(float), beyond)


def assembled(rows: list[Training], *, gap: bool, law: str = "gaussian") -> Assembled:
    return assemble(
        SYSTEM, NORMALISER, SimulatorPrior(gap=GapGP(scale=0.05) if gap else None), Gaussian(), rows, {"y": SIGMA}, {},
        noise=NoiseModel(), pool=1, keys=list(jax.random.split(KEY, len(rows))), precision="float64", law=law,
    )  # fmt: skip


def slope_and_offset(
    method: Any, kind: str, *, gap: bool, steps: int, nu: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Over eight sets of rows."""
    law = "gaussian" if np.isinf(nu) else "student_t"
    made = assembled([training(seed, kind, nu) for seed in range(8)], gap=gap, law=law)

    def fitted(problem: Problem) -> jax.Array:
        rule = method.bind(made.setting, problem)
        state = rule.init(KEY)
        state = jax.lax.fori_loop(0, steps, lambda i, state: rule.step(KEY, state, None)[0], state)
        return jnp.mean(rule.predict(state, jnp.asarray([[-2.0], [2.0]])).particles, axis=0)[:, 0]

    low, high = np.asarray(jax.jit(lambda problems: jax.lax.map(fitted, problems))(made.problems)).T
    return (high - low) / 4, (high + low) / 2


def test_sites_are_of_the_gap_whose_lengthscales_were_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The noise is known, and so is the gap's scale: only the lengthscale can make another target."""

    def targets(relevance: float) -> np.ndarray:
        monkeypatch.setattr("simpel_cli.inference.scales.most_likely", lambda *_: np.array([relevance]))
        problems = assemble(
            SYSTEM, NORMALISER, SimulatorPrior(gap=GapGP(scale=0.5, lengthscale="auto")), Gaussian(), [training(0, "ends")],
            {"y": SIGMA}, {}, noise=NoiseModel(learn=False), pool=1, keys=[KEY], precision="float64", law="gaussian",
        ).problems  # fmt: skip
        return np.asarray(problems.y)

    long, short = targets(0.1), targets(5.0)
    at_ends = training(0, "ends").beyond != 0
    moved = np.abs(long - short)[0, : len(at_ends)]
    assert moved[at_ends].max() > 1e-3
    assert moved[~at_ends].max() == 0


@pytest.mark.parametrize(
    ("method", "gap", "steps"), [(SysID(starts=2), False, 40), (ExactGP(SysID(starts=2)), True, 1)], ids=["sysid", "gp"]
)
def test_a_sensor_clipped_at_both_ends_does_not_flatten_the_line(method: Any, gap: bool, steps: int) -> None:
    """30 % of the rows lie at an end, with a noise of a tenth of the span between them."""
    share = np.mean([measured(seed)[2] != 0 for seed in range(8)])
    assert 0.25 < share < 0.35
    a, b = slope_and_offset(method, "marked", gap=gap, steps=steps)
    clipped, _ = slope_and_offset(method, "clipped", gap=gap, steps=steps)
    error = SIGMA / np.sqrt(8 * 160 * 4 / 3 * (1 - share))  # of the mean slope, by the rows between the ends
    print(
        f"share {share:.2f}: a = {a.mean():.3f} ({A}), clipped {clipped.mean():.3f}, b = {b.mean():.3f}, error {error:.3f}"
    )
    assert abs(a.mean() - A) < 4 * error
    assert abs(b.mean() - B) < 0.05
    assert clipped.mean() < A - 0.2


def test_heavy_tails_at_the_ends_do_not_flatten_the_line() -> None:
    a, b = slope_and_offset(SysID(starts=2), "marked", gap=False, steps=40, nu=3.0)
    clipped, _ = slope_and_offset(SysID(starts=2), "clipped", gap=False, steps=40, nu=3.0)
    print(
        f"a = {a.mean():.3f} +- {a.std(ddof=1) / 8**0.5:.3f} ({A}), clipped {clipped.mean():.3f}, b = {b.mean():.3f} ({B})"
    )
    assert abs(a.mean() - A) < 0.05
    assert abs(b.mean() - B) < 0.05
    assert clipped.mean() < A - 0.1


def test_shares_of_many_rows_have_sites_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is looked at together is bounded; the sites are about the same."""
    rows = training(0, "marked")
    at = np.flatnonzero(rows.beyond)
    whole = assembled([rows], gap=True).problems
    monkeypatch.setattr(scales, "SCALE_POINTS", 80)
    shares = assembled([rows], gap=True).problems
    for problem in (whole, shares):
        assert problem.tells is not None
        assert np.array_equal(np.asarray(problem.tells)[0, : len(rows.x), 0] == 0, rows.beyond[:, 0] != 0)  # type: ignore[index]
        values = np.asarray(problem.y)[0, : len(rows.x), 0]
        inside = np.setdiff1d(np.arange(len(rows.x)), at)
        np.testing.assert_allclose(values[inside], ((rows.y - NORMALISER.y_mean) / NORMALISER.y_std)[inside, 0])
    precision = [np.asarray(problem.precision)[0, at, 0] for problem in (whole, shares)]
    assert (precision[0] > 0).all()
    assert not np.array_equal(*precision)
    assert np.corrcoef(*np.log(precision))[0, 1] > 0.95


@pytest.mark.parametrize("law", ["gaussian", "student_t"])
def test_rows_that_do_not_tell_keep_their_weight(law: str) -> None:
    rows = training(3, "marked")
    made = assemble(
        SYSTEM, NORMALISER, SimulatorPrior(gap=None), Gaussian(), [rows], {"y": SIGMA}, {}, noise=NoiseModel(), pool=1,
        keys=[KEY], precision="float64", law=law,
    ).problems  # fmt: skip
    at = np.flatnonzero(rows.beyond)
    assert (made.tail is None) == (law == "gaussian")
    np.testing.assert_allclose(np.asarray(made.weights)[0, at], np.asarray(made.precision)[0, at])
    lifted = np.asarray(made.y)[0, at, 0] * NORMALISER.y_std[0] + NORMALISER.y_mean[0]
    side = rows.beyond[at, 0]  # type: ignore[index]
    assert np.mean(side * (lifted - np.where(side > 0, HIGH, LOW)) > 0) > 0.9  # beyond the end


def test_a_row_at_an_end_has_the_noise_of_its_own() -> None:
    """Alone, it is the site of its own noise, whatever that of the others is."""
    mean, covariance = np.array([0.5, 0.5]), np.diag([1.0, 1.0])
    found = propagated(mean, covariance, np.ones(2), np.ones(2), np.array([0.5, 2.5]))
    for j, sigma in enumerate((0.5, 2.5)):
        target, precision = site(0.5, 1.0, 1.0, 1.0, sigma)
        assert found.target[j] == pytest.approx(target, rel=1e-6)
        assert found.variance[j] == pytest.approx(1 / precision, rel=1e-6)
    assert found.variance[1] > 5 * found.variance[0]
