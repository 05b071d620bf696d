"""Simulations whose remainders have a memory, against the Gaussian process that they are."""

import numpy as np
import pytest

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.errors_ahead import FIRST, Assessor
from simpel_cli.filtering.setup import Setup, setup
from simulators.model import Declared

DT, ROWS, RATE = 0.1, 40, 0.8
ROOM = Declared(
    "room", dt=DT, states={"T": {"unit": "K", "range": [-20, 20]}},
    inputs={"u": {"unit": "W", "range": [-3, 3], "between_rows": "held"}},
    parameters={"a": {"unit": "1/s", "range": [0.1, 1.5]}}, dynamics={"T": "u - a*T"},
).model()  # fmt: skip


def measured(seed: int = 0) -> Recording:
    random = np.random.default_rng(seed)
    episodes = []
    for e in range(3):
        u, x = np.repeat(random.uniform(-3, 3, 8), 5)[:ROWS], np.zeros(ROWS)
        x[0] = 2.0
        for i in range(ROWS - 1):
            x[i + 1] = u[i] / RATE + (x[i] - u[i] / RATE) * np.exp(-RATE * DT)
        o = np.zeros(ROWS)
        for i in range(1, ROWS):
            o[i] = np.exp(-0.3 * DT) * o[i - 1] + 0.05 * random.normal()
        noisy = x + o + 0.01 * random.normal(size=ROWS)
        episodes.append(Episode(str(e), np.arange(ROWS) * DT, noisy[:, None], u[:, None], np.zeros((ROWS, 0))))
    return Recording(tuple(episodes[:2]), tuple(episodes[2:]), (), {"T": 0.01}, (), (Check("c", True, ""),), ())


def simulated(recording: Recording) -> Setup:
    return setup(ROOM, recording, (), [], 4, simulated=True)


def test_the_likelihood_is_that_of_a_gaussian_process() -> None:
    """Start, remainder and noise are Gaussian and the model is linear: y ~ N(simulation, covariance), exactly."""
    plan = simulated(measured())
    co = plan.coordinates
    assert co.driven == (1,)
    assert [q.name for q in plan.augmented.model.states] == ["T", "remainder_T"]
    a, forgetting, r, q = RATE, 0.5, 0.02, 0.15
    z = plan.start.copy()
    n_p, n_r, _ = co.sizes
    for row, value in zip((0, 1, n_p, n_p + n_r), (a, forgetting, r, q), strict=True):
        z[row] = co.unit(row, value)
    time = np.arange(plan.windows.y.shape[1]) * DT
    found = Assessor(plan, 5)(z, plan.windows).log_likelihood
    for w in range(len(found)):
        episode, begin = measured().train[plan.windows.episode[w]], plan.windows.begin[w]
        ok = plan.windows.ok[w, :, 0] > 0
        x = np.zeros(len(time))
        x[0] = plan.windows.start[w, 0]
        for i in range(len(time) - 1):
            u = episode.inputs[min(begin + i, ROWS - 1), 0]
            x[i + 1] = u / a + (x[i] - u / a) * np.exp(-a * DT)
        t, sd = time[:, None], plan.windows.spread[w]
        cov = sd[0] ** 2 * np.exp(-a * (t + t.T)) + sd[1] ** 2 * np.exp(-forgetting * (t + t.T))
        cov += q**2 / (2 * forgetting) * (np.exp(-forgetting * abs(t - t.T)) - np.exp(-forgetting * (t + t.T)))
        cov = (cov + r**2 * np.eye(len(t)))[np.ix_(ok, ok)]
        e = (plan.windows.y[w, :, 0] - x)[ok]
        wanted = -0.5 * (e @ np.linalg.solve(cov, e) + np.linalg.slogdet(2 * np.pi * cov)[1])
        assert found[w] == pytest.approx(wanted, rel=1e-3)


def test_a_free_run_is_the_simulation_alone() -> None:
    """What remained when the free run begins is no part of it."""
    plan = simulated(measured())
    n_p, n_r, _ = plan.coordinates.sizes
    z = plan.start.copy()
    for row, value in zip((0, 1, n_p, n_p + n_r), (RATE, 0.3, 0.01, 0.15), strict=True):
        z[row] = plan.coordinates.unit(row, value)
    found = Assessor(plan, 5)(z, plan.windows)
    assert np.abs(found.track.mean[:, FIRST - 1, 1]).max() > 0.05
    for w in range(len(found.free)):
        x, begin = found.track.mean[w, FIRST - 1, 0], plan.windows.begin[w]
        for k in range(FIRST - 1, plan.windows.y.shape[1] - 1):
            u = measured().train[plan.windows.episode[w]].inputs[begin + k, 0]
            x = u / RATE + (x - u / RATE) * np.exp(-RATE * DT)
            assert found.free_mean[w, k + 1, 0] == pytest.approx(x, abs=1e-5)
