"""The motion that a late sensor looks back along, where it has a closed form."""

import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.filtering.likelihood.sensor_delay import Motion, moving
from simpel_cli.filtering.likelihood.track import Noise
from simpel_cli.filtering.setup import setup
from simulators.effects import Expression
from simulators.model import Declared


def at(t: float) -> Motion:
    """Of dx = -x^2 with x = 1/(1 + t), whose derivatives are -x^2, 2 x^3 and -6 x^4."""
    x = 1 / (1 + t)
    return moving(jnp.array([-(x**2)]), jnp.array([[-2 * x]]))


@pytest.mark.parametrize("t", [0.0, 0.5])
def test_the_third_derivative_has_what_the_slope_of_the_rates_changes(t: float) -> None:
    x, step = 1 / (1 + t), 0.01
    true = np.array([-(x**2), 2 * x**3, -6 * x**4])
    found = np.asarray(at(t).since(at(t - step), step).orders)[:, 0]
    np.testing.assert_allclose(found, true, rtol=0.03)
    assert np.asarray(at(t).orders)[2, 0] == pytest.approx(-4 * x**4)  # as long as no row lies behind it


def test_a_filter_looks_back_along_a_bent_motion_to_third_order() -> None:
    """Without what the slope's own change adds, the reading would be off by d^3/6 of 2 x^4."""
    dt, rows, late = 0.1, 40, 0.08
    delay = Expression(
        "late", acts_on="x", operator="sensor_delay", parameters={"t": {"range": [0.0, 0.2], "unit": "s"}}
    )
    model = Declared(
        "decay", dt=dt, states={"x": {"unit": "1", "range": [0, 2]}}, inputs={}, dynamics={"x": "-x*x"}
    ).model()
    time = dt * np.arange(rows)
    x = 1 / (1 + time)
    episode = Episode("e", time, x[:, None], np.zeros((rows, 0)), np.zeros((rows, 0)))
    plan = setup(model, Recording((episode,), (), (), {"x": 0.1}, (), (), ()), (), [delay], 4)
    p = plan.augmented.neutral.copy()
    p[[q.name for q in plan.augmented.params].index("late_x_t")] = late
    deaf, still = Noise(jnp.full(1, 1e6), jnp.zeros(1)), (jnp.ones(1), jnp.full(1, 1e-9))
    nothing, inputs = jnp.zeros((rows, 1)), jnp.zeros((plan.lead + rows, 0))
    track, _ = plan.rule.track(jnp.asarray(p), deaf, nothing, nothing + 1, inputs, *still)
    off = -np.asarray(track.innovation)[3:, 0] - 1 / (1 + time[3:] - late)
    assert (np.abs(off) < 0.5 * late**3 / 6 * 2 * x[3:] ** 4).all()
