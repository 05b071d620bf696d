"""Forces that go with time: found with their period, and neither process noise nor a friction is taken for one."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from linear_plant import DT
from scipy.stats import multivariate_normal
from test_interactions import FRICTION, NOISE, ROWS

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.search.unexplained.disturbances import (
    Disturbance,
    _evidence,
    _statistics,
    time_dependent_disturbance,
)
from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile, evidence
from simpel_cli.discovery.verdict.remainder import dependence, remainder_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simulators.model import Declared, Model

PERIOD = 0.9  # s


def test_evidence_is_that_of_a_linear_model_with_normal_weights() -> None:
    random = np.random.default_rng(0)
    columns, error = random.normal(size=(7, 3)), random.normal(size=7)
    found = evidence(columns.T @ columns, columns.T @ error, np.array([0.2, 2.0]))
    none = multivariate_normal(np.zeros(7), np.eye(7)).logpdf(error)
    wanted = [
        multivariate_normal(np.zeros(7), np.eye(7) + a**2 * columns @ columns.T).logpdf(error) - none
        for a in (0.2, 2.0)
    ]
    np.testing.assert_allclose(found, wanted, rtol=1e-10)
    assert evidence(np.full((1, 1), np.nan), np.zeros(1), np.ones(2)).tolist() == [-np.inf, -np.inf]


def wandering(correlation: float, std: float, seed: int) -> Callable[[float, float, float], float]:
    """Return an Ornstein-Uhlenbeck force; time starts anew with every episode."""
    random, now, before = np.random.default_rng(seed), 0.0, 0.0

    def force(t: float, _: float, __: float) -> float:
        nonlocal now, before
        decay = np.exp(-max(t - before, 0.0) / correlation)
        now = now * decay + std * np.sqrt(1 - decay**2) * random.normal() if t > before else std * random.normal()
        before = t
        return float(now)

    return force


@cache
def glider() -> Model:
    """Of one model searches share their programs."""
    return Declared(
        "glider", dt=DT,
        states={"s": {"unit": "m", "range": [-9, 9]}, "v": {"unit": "m/s", "range": [-5, 5]}},
        inputs={"u": {"unit": "V", "range": [-9, 9]}},
        parameters={"b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": "b*u - 0.7*v"},
    ).model()  # fmt: skip


def pushed(force: Callable[[float, float, float], float], shaken: float, seed: int) -> NoiseProfile:
    """Search episodes of dv/dt = 1.3 u - 0.7 v + force(t, phase, v), each with its own phase, by a simulator without it."""
    random, fine, episodes = np.random.default_rng(seed), 20, []
    for k in range(5):
        s, v, phase = random.normal(), random.normal(), random.uniform(0, 2 * np.pi)
        states, inputs = [], 2 * random.normal(size=ROWS).repeat(2)[:ROWS]
        for i, u in enumerate(inputs):
            states.append([s, v])
            for j in range(fine):
                t = (i + j / fine) * DT
                s += v * DT / fine
                v += (1.3 * u - 0.7 * v + force(t, phase, v)) * DT / fine + shaken * np.sqrt(
                    DT / fine
                ) * random.normal()
        measured = np.array(states) + NOISE * random.normal(size=(ROWS, 2))
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, measured, inputs[:, None], np.zeros((ROWS, 0))))
    checks = (Check("c", True, ""),)
    data = Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"s": NOISE, "v": NOISE}, (), checks, ())
    plan = setup(glider(), data, (), [FRICTION], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=10))
    return NoiseProfile(search, Assessor(plan, 10), select(search).chosen)


def select_nothing(levels: NoiseProfile) -> Selection:
    return Selection(levels.chosen, levels.chosen, (levels.chosen,), (), (), (), None)


def said(levels: NoiseProfile, found: Disturbance) -> dict[str, Any]:
    learnt = levels.assessor(levels.chosen.optimum.z, levels.search.plan.windows)
    remainder = remainder_of(levels.search, select_nothing(levels), found, learnt)
    assert remainder is not None
    return remainder


def test_evidence_of_windows_is_that_of_the_dense_equations() -> None:
    """Three windows, two frequencies, known unknowns that tie the windows together."""
    random = np.random.default_rng(0)
    count, rows, frequencies, unknowns = 3, 8, 2, 4
    columns = random.normal(size=(count, rows, 2, frequencies))
    known = np.linalg.qr(random.normal(size=(count * rows, unknowns)))[0]
    error = random.normal(size=count * rows)
    error -= known @ (known.T @ error)
    track: Any = None
    shape = (count, rows, 1)
    level = Level(
        0.0, track, error.reshape(shape), error.reshape(shape), known.reshape(*shape, unknowns), np.ones(shape)
    )
    sizes = np.array([0.3, 2.0])
    found, weights = _evidence(_statistics(level, columns), sizes)
    for f in range(frequencies):
        dense = np.zeros((count, rows, count, 2))
        dense[np.arange(count), :, np.arange(count)] = columns[..., f]
        free = dense.reshape(count * rows, -1)
        free = free - known @ (known.T @ free)
        np.testing.assert_allclose(found[f], evidence(free.T @ free, free.T @ error, sizes), rtol=1e-9)
        posterior = np.linalg.solve(free.T @ free + np.eye(2 * count) / sizes[-1] ** 2, free.T @ error)
        np.testing.assert_allclose(weights[f].ravel(), posterior, rtol=1e-8)


@pytest.mark.parametrize("shaken", [0.0, 0.2])
def test_a_force_that_swings_is_found_with_its_period(shaken: float) -> None:
    levels = pushed(lambda t, phase, _: 0.5 * np.sin(2 * np.pi * t / PERIOD + phase), shaken, 0)
    found = time_dependent_disturbance(levels)
    assert found is not None
    assert found.acts_on == "v"
    assert found.period == pytest.approx(PERIOD, rel=0.1)
    assert found.rms == pytest.approx(0.5 / np.sqrt(2), rel=0.35)
    remainder = said(levels, found)
    assert (remainder["depends_on"], remainder["period"], remainder["unit"]) == (["time"], found.period, "m/s^2")
    assert f"with a period of about {found.period:.3g} s" in remainder["description"]
    assert "that of u" not in remainder["description"]
    # an input that swings in the same time is named
    windows = levels.search.plan.windows
    wave = np.sin(2 * np.pi * DT / found.period * np.arange(windows.u.shape[1]))[None, :, None]
    levels.search.plan = levels.search.plan._replace(windows=windows._replace(u=0.3 * windows.u + 3 * wave))
    alike = remainder_of(
        levels.search, select_nothing(levels), found, levels.assessor(levels.chosen.optimum.z, windows)
    )
    assert alike is not None
    assert alike["description"].endswith("the same as that of u: possibly a function of the input")


@pytest.mark.parametrize("correlation", [0.3, 1.0])
def test_a_force_that_wanders_has_no_period(correlation: float) -> None:
    found = time_dependent_disturbance(pushed(wandering(correlation, 1.0, 5), 0.0, 3))
    assert found is None or found.period is None


def test_a_load_of_every_episode_is_no_swing() -> None:
    levels = pushed(lambda _, phase, __: 0.4 * (phase - np.pi), 0.0, 4)
    found = time_dependent_disturbance(levels)
    assert found is not None
    assert found.period is None
    remainder = said(levels, found)
    assert (remainder["period"], dependence(remainder)) == (None, "time")
    assert remainder["description"].endswith("wanders with time: it has no single period")
    assert found.rms == pytest.approx(0.4 * np.pi / 3**0.5, rel=0.5)  # four loads


@pytest.mark.parametrize(("friction", "shaken"), [(0.0, 0.0), (0.0, 0.3), (0.4, 0.0)])
def test_noise_and_a_named_friction_are_no_swings(friction: float, shaken: float) -> None:
    assert time_dependent_disturbance(pushed(lambda _, __, v: -friction * v, shaken, 1)) is None
