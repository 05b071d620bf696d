"""Outputs that have a held input in them, as an accelerometer does: the filter reads them as a transition does."""

import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.dynamics.arriving import acting
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.filtering.setup import setup
from simpel_cli.filtering.tracks import Tracks
from simulators.model import Declared, Model
from simulators.step import one_step
from simulators.worlds.motion import Drifting, Inputs, true_values


def cart(word: str) -> Model:
    return Declared(
        "cart", dt=0.05, substeps=4, states={"v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": {"unit": "V", "range": [-3, 3], "between_rows": word}},
        parameters={"a": {"range": [0.3, 1.3]}, "b": {"range": [0.6, 2.0]}},
        outputs={"acc": {"unit": "m/s^2", "expression": "b*u - a*v"}}, dynamics={"v": "b*u - a*v"},
    ).model()  # fmt: skip


@pytest.mark.parametrize("word", ["held", "linear"])
@pytest.mark.parametrize("clocked", [False, True])
def test_an_accelerometer_feels_the_input_of_its_row(word: str, clocked: bool) -> None:
    model, p, n = cart(word), np.array([0.7, 1.3]), 40
    encoding = encoding_of(model, ("acc",))
    step = transition(model, encoding).step
    u, v, acc = np.random.default_rng(0).uniform(-3, 3, n + 1), [0.2], []
    for k in range(n):
        x = encoding.to_x(np.array([v[-1]]), u[k : k + (2 if word == "linear" else 1)])
        y = np.asarray(step(jnp.asarray(x), jnp.asarray(p)))
        v.append(v[-1] + y[0])
        acc.append(y[1])
    np.testing.assert_allclose(acc, 1.3 * u[:n] - 0.7 * np.array(v[:n]), rtol=1e-5)
    late = np.zeros((n, 2)) if clocked else None
    episode = Episode(
        "e", 0.05 * np.arange(n), np.array(v[:n])[:, None], u[:n, None], np.array(acc)[:, None], late=late
    )
    recording = Recording((episode,), (), ("acc",), {"v": 0.01, "acc": 0.05}, (), (), ())
    plan = setup(model, recording, (), [])
    z = plan.start.copy()
    z[:2] = plan.coordinates.unit(np.arange(2), p)
    innovation = np.asarray(Tracks(plan).track(z, plan.windows).innovation)[0, 1:]
    assert np.abs(innovation).max() < 1e-3  # a row late it is 7 m/s^2


def late_cart(word: str, lag: bool) -> Model:
    given = {"unit": "V", "range": [-3, 3], "between_rows": word, "delay": "d"}
    return Declared(
        "cart", dt=0.05, substeps=4, states={"v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": given | ({"lag": 0.03} if lag else {}), "w": {"unit": "V", "range": [-1, 1]}},
        parameters={"a": {"range": [0.3, 1.3]}, "b": {"range": [0.6, 2.0]}, "d": {"unit": "s", "range": [0.0, 0.11]}},
        outputs={"acc": {"unit": "m/s^2", "expression": "b*u - a*v + w"}}, dynamics={"v": "b*u - a*v + w"},
    ).model()  # fmt: skip


def truth(model: Model, p: np.ndarray, u: np.ndarray, word: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, speeds and accelerations of the rows, by the integrator that measurements are made with."""
    times = 0.05 * np.arange(len(u))[None]
    inputs = Inputs.of_rows(times, u[None], (word, "held"))
    true = true_values(model, np.array([[0.2]]), inputs, Drifting(p[None], np.zeros(3)), times, cause="a test")
    return times[0], true["v"][0], true["acc"][0]


LATE = [0.0, 0.05, 0.0625, 0.1, 0.1075]


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("word", ["held", "linear"])
def test_an_accelerometer_feels_a_late_input_when_it_arrives(word: str, late: float) -> None:
    model, n = late_cart(word, lag=False), 30
    p = np.array([0.7, 1.3, late])
    u = np.random.default_rng(0).uniform(-1, 1, (n, 2))
    times, v, acc = truth(model, p, u, word)
    back = times - late
    held = u[np.maximum(np.floor(back / 0.05 + 1e-6).astype(int), 0), 0]
    felt = np.interp(back, times, u[:, 0]) if word == "linear" else held
    np.testing.assert_allclose(acc, 1.3 * felt - 0.7 * v + u[:, 1], atol=1e-9)  # what simulate writes
    past = model.past()
    encoding, exported = encoding_of(model, ("acc",), past), one_step(model)
    step = transition(model, encoding).step
    # what arrives within the first of four substeps acts through all of it, of a line by its first moment
    share = max(0.0, 1 - 4 * (late / 0.05 % 1)) if late / 0.05 % 1 > 1e-9 else 0.0
    tight = {"held": 1e-5, "linear": 0.15 if share else 1e-5}[word]
    if word == "held":
        felt = felt + share * (np.append(felt[1:], 0.0) - felt)
    for k in range(past, n - 1):
        stacked = u[k - past : k + 1].ravel()
        if word == "linear":
            stacked = np.append(stacked, u[k + 1, 0])
        y = np.asarray(step(jnp.asarray(encoding.to_x(v[k : k + 1], stacked)), jnp.asarray(p)))
        after, read = (float(value) for value in exported(v[k], stacked, p))
        np.testing.assert_allclose(read, 1.3 * felt[k] - 0.7 * v[k] + u[k, 1], atol=tight)
        np.testing.assert_allclose([y[1], y[0]], [read, after - v[k]], atol=1e-5)
    np.testing.assert_allclose(acting(model, u, p)[past:-1, 0], felt[past:-1], atol=tight)


def test_a_lagged_input_is_felt_as_it_arrives() -> None:
    model, p = late_cart("held", lag=True), np.array([0.7, 1.3, 0.02])
    u = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    past = model.past()
    encoding = encoding_of(model, ("acc",), past)
    step, exported = transition(model, encoding).step, one_step(model)
    for k in range(past, 29):
        stacked = u[k - past : k + 1].ravel()
        y = np.asarray(step(jnp.asarray(encoding.to_x(np.array([0.4]), stacked)), jnp.asarray(p)))
        read = float(exported(0.4, stacked, p)[1])
        np.testing.assert_allclose(y[1], read, atol=1e-5)
        assert abs(read - (1.3 * u[k, 0] - 0.28 + u[k, 1])) > 1e-3  # not the input as it is given


@pytest.mark.parametrize("word", ["held", "linear", "smooth"])
def test_the_filter_feels_a_late_input_when_it_arrives(word: str) -> None:
    model, p, n = late_cart(word, lag=False), np.array([0.7, 1.3, 0.0625]), 60
    u = np.random.default_rng(1).uniform(-1, 1, (n, 2))
    times, v, acc = truth(model, p, u, word)
    episode = Episode("e", times, v[:, None], u, acc[:, None])
    recording = Recording((episode,), (), ("acc",), {"v": 0.01, "acc": 0.05}, (), (), ())
    plan = setup(model, recording, (), [], 4)  # an arrival at the end of a substep
    z = plan.start.copy()
    z[:3] = plan.coordinates.unit(np.arange(3), p)
    innovation = np.asarray(Tracks(plan).track(z, plan.windows).innovation)[0, model.past() + 1 :]
    counted = (
        innovation[:-2] if word == "smooth" else innovation
    )  # what comes behind a window is taken to go on as a parabola
    assert np.abs(counted).max() < 2e-3
