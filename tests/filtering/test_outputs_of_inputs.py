"""Outputs that have a held input in them, as an accelerometer does: the filter reads them as a transition does."""

import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.filtering.setup import setup
from simpel_cli.filtering.tracks import Tracks
from simulators.model import Declared, Model


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
