"""The latent force against a dense Gaussian posterior, a closed form, and what finite differences make of the same data."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.latent_force import Forces, smooth
from simpel_cli.filtering.likelihood.track import Filter, Track
from simpel_cli.filtering.measurements.windows import Windows

DT = 0.1


class Linear:
    """x[k+1] = A x[k] + b + n,  n ~ N(0, Q);  y = C x + r,  r ~ N(0, R);  x[0] ~ N(m, P)."""

    def __init__(self, a: Any, q: Any, c: Any, r: Any, p: Any, b: Any = 0.0, m: Any = 0.0) -> None:
        self.a, self.q, self.c, self.p = (np.atleast_2d(np.asarray(v, float)) for v in (a, q, c, p))
        self.r = np.atleast_1d(np.asarray(r, float))
        n = len(self.a)
        self.b, self.m = np.zeros(n) + b, np.zeros(n) + m

    def track(self, y: np.ndarray) -> Track:
        """Kalman filter of one window, in the textbook's form; NaN = not measured."""
        rows: list[tuple[np.ndarray, ...]] = []
        x, p = self.m, self.p
        for y_k in y:
            predicted, predicted_cov = x, p
            good = np.isfinite(y_k)
            if good.any():
                c = self.c[good]
                gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.diag(self.r[good]))
                x = x + gain @ (y_k[good] - c @ x)
                p = p - gain @ c @ p
            rows.append((y_k, self.r, predicted, predicted_cov, x, p, self.a, self.c))
            x, p = self.a @ x + self.b, self.a @ p @ self.a.T + self.q
        return Track(*(np.stack(column)[None] for column in zip(*rows, strict=True)))

    def posterior(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (T, n) and covariance (T n, T n) of all states at once, from their joint precision."""
        rows, n = len(y), len(self.a)
        precision, shift = np.zeros((rows * n, rows * n)), np.zeros(rows * n)

        def add(block: np.ndarray, value: np.ndarray, cov: np.ndarray) -> None:
            precision[:] += block.T @ np.linalg.inv(cov) @ block
            shift[:] += block.T @ np.linalg.inv(cov) @ value

        at = [np.eye(rows * n)[k * n : (k + 1) * n] for k in range(rows)]
        add(at[0], self.m, self.p)
        for k in range(rows - 1):
            add(at[k + 1] - self.a @ at[k], self.b, self.q)
        for k in range(rows):
            for j in np.flatnonzero(np.isfinite(y[k])):
                add(self.c[j : j + 1] @ at[k], y[k, j : j + 1], self.r[j : j + 1, None])
        cov = np.linalg.inv(precision)
        return (cov @ shift).reshape(rows, n), cov

    def simulate(self, rows: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        states = [random.multivariate_normal(self.m, self.p)]
        for _ in range(rows - 1):
            states.append(self.a @ states[-1] + self.b + random.multivariate_normal(np.zeros(len(self.a)), self.q))
        x = np.stack(states)
        return x, x @ self.c.T + random.normal(size=(rows, len(self.r))) * np.sqrt(self.r)


WALK = Linear(1.0, 0.3, 1.0, 0.2, 4.0, b=0.5, m=1.0)
OSCILLATOR = Linear(
    [[0.98, 0.09], [-0.3, 0.93]],
    [[1e-4, 2e-4], [2e-4, 9e-2]],
    np.eye(2),
    [1e-3, 4e-2],
    np.diag([1.0, 2.0]),
    b=[0.0, 0.1],
)
POSITION_ONLY = Linear([[1, DT], [0, 1]], [[1e-5, 1e-4], [1e-4, 4e-3]], [[1, 0]], [1e-4], np.diag([1.0, 3.0]))


@pytest.mark.parametrize("system", [WALK, OSCILLATOR, POSITION_ONLY])
def test_smoother_is_the_dense_posterior(system: Linear) -> None:
    random = np.random.default_rng(4)
    _, y = system.simulate(12, random)
    y[5], y[7, 0] = np.nan, np.nan
    found = smooth(system.track(y))
    mean, cov = system.posterior(y)
    n = len(system.a)
    np.testing.assert_allclose(found.mean[0], mean, rtol=1e-8, atol=1e-10)
    for k in range(12):
        rows = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(found.cov[0, k], cov[rows, rows], rtol=1e-7, atol=1e-12)
    for k in range(11):  # x[k+1] - A x[k] - b, of the joint posterior
        step = np.zeros((n, 12 * n))
        step[:, k * n : (k + 1) * n], step[:, (k + 1) * n : (k + 2) * n] = -system.a, np.eye(n)
        np.testing.assert_allclose(found.moved[0, k], step @ mean.ravel() - system.b, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found.moved_cov[0, k], step @ cov @ step.T, rtol=1e-6, atol=1e-12)


def test_exact_measurements_leave_differences() -> None:
    """Closed form: without measurement noise the force of a random walk is the difference of its measurements."""
    y = np.array([[0.0], [1.0], [3.0], [2.0]])
    found = smooth(Linear(1.0, 0.3, 1.0, 1e-14, 4.0).track(y))
    np.testing.assert_allclose(found.moved[0], np.diff(y, axis=0), atol=1e-9)
    np.testing.assert_allclose(found.moved_cov[0], 0.0, atol=1e-9)


def test_two_measurements_of_a_random_walk() -> None:
    """Closed form: w | y0, y1 ~ N(q d/(q + 2r), q - q^2/(q + 2r)), d = y1 - y0, under a flat prior of x0."""
    q, r, d = 0.3, 0.2, 0.7
    found = smooth(Linear(1.0, q, 1.0, r, 1e9).track(np.array([[1.0], [1.0 + d]])))
    assert found.moved[0, 0, 0] == pytest.approx(q * d / (q + 2 * r), rel=1e-6)
    assert found.moved_cov[0, 0, 0, 0] == pytest.approx(q - q**2 / (q + 2 * r), rel=1e-6)


def test_units_do_not_matter() -> None:
    """States in micrometres and gigahertz give the same answer as in metres and hertz."""
    scale = np.diag([1e6, 1e-9])
    back = np.linalg.inv(scale)
    s = OSCILLATOR
    other = Linear(
        scale @ s.a @ back, scale @ s.q @ scale, s.c @ back, s.r, scale @ s.p @ scale, b=scale @ s.b, m=scale @ s.m
    )
    _, y = s.simulate(20, np.random.default_rng(0))
    one, two = smooth(s.track(y)), smooth(other.track(y))
    np.testing.assert_allclose(two.moved @ back, one.moved, rtol=1e-6, atol=1e-9)


def test_a_diverged_window_is_nan_and_alone() -> None:
    _, y = WALK.simulate(8, np.random.default_rng(1))
    track = WALK.track(y)
    both = Track(*(np.concatenate([a, np.full_like(a, np.nan)]) for a in track))
    found = smooth(both)
    np.testing.assert_array_equal(found.mean[0], smooth(track).mean[0])
    assert np.isnan(found.mean[1]).all()
    assert np.isnan(found.moved_cov[1]).all()


def test_rounding_below_zero_is_no_error() -> None:
    """A covariance that rounding left without full rank, or slightly below zero, still smooths."""
    _, y = POSITION_ONLY.simulate(10, np.random.default_rng(2))
    track = POSITION_ONLY.track(y)
    flat = np.array([[1.0, 1.0], [1.0, 1.0 - 1e-15]]) * 1e-6
    found = smooth(track._replace(predicted_cov=track.predicted_cov * 0 + flat))
    assert np.isfinite(found.mean).all()


def force_of(system: Linear, y: np.ndarray) -> Any:
    """Latent force by the class that a search uses, with stand-ins for the model."""
    a, b = jnp.asarray(system.a), jnp.asarray(system.b)
    rule = Filter(
        name="linear",
        track=system.track,
        pushes=pytest.fail,
        slopes=pytest.fail,
        flow=lambda p, x, u: a @ x + b + 0.0 * p[0] + 0.0 * jnp.sum(u),
        measure=lambda p, x, u: x,
        read=lambda p, before, u_before, x, u: x,
        delayed_inputs=lambda p, u: u[:, None, None, :],
    )
    known = np.array([False])
    coordinates = Coordinates(np.zeros(1), np.ones(1), known, known, (1, 0, 0), (), len(b))
    rows = len(y)
    windows = Windows(
        y=y[None], ok=np.isfinite(y[None]) * 1.0, u=np.zeros((1, rows, 1)), start=system.m[None], spread=np.ones((1, len(b))),
        episode=np.zeros(1, int), begin=np.zeros(1, int), clock=np.zeros((1, rows, 0)),
    )  # fmt: skip
    return Forces(rule, coordinates, DT)(np.zeros(1), system.track(y), windows)


def test_a_planted_force_is_seen_where_differences_see_noise() -> None:
    """A slow force on a velocity: smoothed it is found to a fifth, finite differences drown it."""
    random = np.random.default_rng(3)
    rows = 1200
    true = 0.8 * np.sin(2 * np.pi * np.arange(rows) * DT / 15)
    velocity = np.concatenate([[0.0], np.cumsum(true * DT)])[:rows]
    position = np.concatenate([[0.0], np.cumsum(velocity * DT)])[:rows]
    y = np.stack([position, velocity], axis=1) + random.normal(size=(rows, 2)) * [0.02, 0.08]
    system = Linear(
        [[1, DT], [0, 1]], np.diag([1e-8, (0.06 * DT**0.5) ** 2]), np.eye(2), [0.02**2, 0.08**2], np.diag([1.0, 1.0])
    )
    found = force_of(system, y)
    assert found.force.shape == (1, rows - 1, 2)
    error = np.std(found.force[0, :, 1] - true[:-1]) / np.std(true)
    differences = np.std(np.diff(y[:, 1]) / DT - true[:-1]) / np.std(true)
    assert error < 0.2 < 1.4 < differences


def test_the_band_covers() -> None:
    """Of forces drawn from the model itself, 95 % lie within 1.96 standard deviations."""
    random = np.random.default_rng(5)
    inside = []
    for _ in range(20):
        x, y = OSCILLATOR.simulate(60, random)
        found = force_of(OSCILLATOR, y)
        true = (x[1:] - x[:-1] @ OSCILLATOR.a.T - OSCILLATOR.b) / DT
        inside.append(np.abs(found.force[0] - true) < 1.96 * found.std[0])
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)
