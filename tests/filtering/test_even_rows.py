"""Rows whose stamps stray are moved to even ones: values of the exact motion there, and fits as good as of even stamps."""

import numpy as np
import pytest
from test_filter_clock import DT, A, B, model, motion

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.estimated_rows import needed, whole, with_estimates
from simpel_cli.filtering.even_rows import even_times, inputs_at, moved, uneven
from simulators.model import Declared

NOISE, ROWS = 0.01, 60
CHECKS = (Check("jitter", False, "38 % of the steps differ; data.resample: 0.2 makes them equal"),)


def recorded(jitter: float, seed: int = 3) -> Recording:
    """Six episodes of the plant, driven by an input that is held for three rows; stamps stray by so much of a row."""
    random, made = np.random.default_rng(seed), []
    for k in range(6):
        time = np.arange(ROWS) * DT + jitter * DT * random.uniform(-1, 1, ROWS)
        u = np.repeat(random.normal(size=ROWS // 3), 3)
        measured = motion(time, u, time) + NOISE * random.normal(size=(ROWS, 2))
        made.append(Episode(f"{k}", time, measured, u[:, None], np.zeros((ROWS, 0))))
    noise = {"s": NOISE, "v": NOISE}
    return Recording(tuple(made[:5]), tuple(made[5:]), (), noise, (), CHECKS, ())


@pytest.fixture(scope="module")
def strayed() -> tuple[Recording, Recording]:
    given = recorded(0.2)
    return given, with_estimates(given, model(), ("s", "v"))


def test_only_rows_that_stray_are_moved(strayed: tuple[Recording, Recording]) -> None:
    given, found = strayed
    assert whole(given)
    assert needed(given, model())
    assert not needed(recorded(0.0), model())
    assert not needed(found, model())
    assert not needed(
        given._replace(
            train=(given.train[0].__class__("a", *(a if a is None else a[:9] for a in given.train[0][1:])),)
        ),
        model(),
    )


def test_values_are_those_of_the_motion_at_even_rows(strayed: tuple[Recording, Recording]) -> None:
    given, found = strayed
    kept, straying = [], []
    for before, after in zip((*given.train, *given.test), (*found.train, *found.test), strict=True):
        assert np.ptp(np.diff(after.time)) < 1e-9
        np.testing.assert_allclose(after.time, before.time, atol=0.25 * DT)
        inside = (after.time > before.time[0]) & (after.time < before.time[-1])
        true = motion(before.time, before.inputs[:, 0], after.time[inside])
        kept.append(after.states[inside] - true)
        straying.append(before.states[inside] - true)
        assert after.weight is None
    assert np.sqrt(np.mean(np.square(np.concatenate(kept)))) < 1.3 * NOISE
    assert np.sqrt(np.mean(np.square(np.concatenate(straying)))) > 2 * NOISE
    (jitter,) = found.checks
    assert jitter.ok
    assert "values moved to even rows" in jitter.detail
    assert "resample" not in jitter.detail


def fitted(recording: Recording) -> tuple[np.ndarray, float]:
    """Least squares of one step of the exact plant: error of (a, b), and root mean square one step ahead, noise and all."""
    rows = [(e.states[:-1], e.inputs[:-1, 0], e.states[1:]) for e in recording.train]
    x, u, after = (np.concatenate(column) for column in zip(*rows, strict=True))
    slopes, *_ = np.linalg.lstsq(np.stack([x[:, 1], u], axis=1), after[:, 1], rcond=None)
    a = -np.log(slopes[0]) / DT
    b = slopes[1] * a / (1 - slopes[0])
    return np.array([a - A, b - B]), float(np.std(after[:, 1] - np.stack([x[:, 1], u], axis=1) @ slopes))


def test_a_fit_is_as_good_as_one_of_even_stamps(strayed: tuple[Recording, Recording]) -> None:
    given, found = strayed
    even, strays, moved_there = (fitted(r) for r in (recorded(0.0), given, found))
    print("errors of a, b and one step ahead: even", even, "as they are", strays, "moved", moved_there)
    assert moved_there[1] < 1.3 * even[1] < 0.6 * strays[1]
    assert np.abs(moved_there[0]).max() < 0.03


def test_inputs_and_shifts_in_closed_form() -> None:
    time = np.array([0.0, 1.2, 1.9, 3.1])
    to = np.array([0.0, 1.0, 2.0, 3.0])
    u = np.array([[1.0], [3.0], [-1.0], [2.0]])
    np.testing.assert_allclose(inputs_at(time, to, u, ())[:, 0], [1.0, 0.2 + 0.7 * 3 - 0.1, -1.0, -0.1 + 0.9 * 2])
    np.testing.assert_allclose(inputs_at(time, to, 2 * time[:, None], (0,))[:, 0], 2 * to)

    def exact(at: np.ndarray) -> np.ndarray:
        """Of dx/dt = u, with u held, and of dx/dt = 2 t, the same with a linear input."""
        held = np.interp(at, time, np.append(0.0, np.cumsum(u[:-1, 0] * np.diff(time))))
        return np.stack([held, at**2], axis=1)

    both = np.concatenate([u, 2 * time[:, None]], axis=1)
    shift = moved(time, to, exact(time), both, (1,), lambda x, u: u)
    np.testing.assert_allclose(exact(time) + shift, exact(to), atol=1e-12)
    nothing = moved(time, to, exact(time), both, (1,), lambda x, u: 0 * u)  # straight between what is known
    np.testing.assert_allclose((exact(time) + nothing)[:, 0], exact(to)[:, 0], atol=1e-12)
    np.testing.assert_allclose(even_times([5 + 0.1 * np.arange(9.0)])[0], 5 + 0.1 * np.arange(9.0))
    even = Episode("e", np.arange(50) * 0.1, np.zeros((50, 1)), np.zeros((50, 1)), np.zeros((50, 0)))
    assert not uneven([even], 0.1)


def test_rounded_stamps_of_an_even_clock_do_not_stray() -> None:
    """A camera at 30 Hz with stamps in ms: a third of its steps differ by 3 %, yet its rows are even."""
    time = np.round(np.arange(90) / 30, 3)
    one = Episode("e", time, np.zeros((90, 1)), np.zeros((90, 1)), np.zeros((90, 0)))
    assert not uneven([one], 1 / 30)
    strayed = time + np.random.default_rng(0).uniform(-3e-3, 3e-3, 90)
    assert uneven([one._replace(time=strayed)], 1 / 30)


def test_inputs_of_slow_rows_go_on_at_both_ends() -> None:
    """Rows a minute apart, whose line begins before the first stamp and ends behind the last."""
    time = 60 * np.arange(9.0) + np.array([4, -5, 3, 0, 1, -2, 3, -4, -5.0])
    (to,) = even_times([time])
    assert to[0] < time[0] - 1
    np.testing.assert_allclose(inputs_at(time, to, np.full((9, 1), 2.0), ()), 2.0)


def test_behind_the_last_stamp_the_last_input_acts() -> None:
    time, to = np.array([0.0, 1.0, 1.9]), np.array([0.0, 1.0, 2.0])
    u = np.array([[1.0], [1.0], [5.0]])
    shift = moved(time, to, np.array([[0.0], [1.0], [1.9]]), u, (), lambda x, u: u)
    np.testing.assert_allclose(shift[:, 0], [0, 0, 0.5], atol=1e-12)


def test_angles_go_round_between_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder that is silent where a window begins: the filter begins there on the turn about 0, whatever the record's."""
    monkeypatch.setattr("simpel_cli.filtering.setup.windows_.LONGEST_RUN", 50)
    wheel = Declared(
        "wheel", dt=0.1,
        states={
            "a": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}, "w": {"unit": "rad/s", "range": [-9, 9]},
        },
        inputs={"u": {"unit": "V", "range": [-3, 3]}}, parameters={"b": {"unit": "rad/s^2/V", "range": [0.5, 2]}},
        dynamics={"a": "w", "w": "b*u"},
    ).model()  # fmt: skip
    random, rows, made = np.random.default_rng(2), 200, []
    for k in range(3):
        time = 0.1 * (np.arange(rows) + random.uniform(-0.3, 0.3, rows))
        states = np.stack([4 * time, np.full(rows, 4.0)], axis=1) + 0.01 * random.normal(size=(rows, 2))
        states[50::50, 0] = np.nan
        made.append(Episode(f"{k}", time, states, np.zeros((rows, 1)), np.zeros((rows, 0))))
    given = Recording(tuple(made[:2]), tuple(made[2:]), (), {"a": 0.01, "w": 0.01}, (), CHECKS, ())
    found = with_estimates(given, wheel, ("a", "w"))
    for before, after in zip((*given.train, *given.test), (*found.train, *found.test), strict=True):
        there = np.isfinite(before.states[:, 0])
        np.testing.assert_allclose(after.states[there, 0], 4 * after.time[there], atol=0.1)


def test_short_episodes_take_their_step_from_all_of_them() -> None:
    """Alone, three rows that stray by a fifth tell their step to 8 % only; a long one keeps that of its own clock."""
    random = np.random.default_rng(0)
    short = [0.2 * (np.arange(n) + random.uniform(-0.2, 0.2, n)) for n in (1, 2, 3, 5) * 60]
    for time, even in zip(short, even_times(short), strict=True):
        np.testing.assert_allclose(np.diff(even), 0.2, rtol=0.02)
        np.testing.assert_allclose(even.mean(), time.mean(), atol=1e-12)
    fast = 0.19 * np.arange(300.0)
    np.testing.assert_allclose(even_times([*short, fast])[-1], fast, atol=1e-9)
