"""How fine the filter integrates, against the exact solution of an oscillator."""

from dataclasses import replace

import numpy as np
import pytest

from simpel_cli.data.recording import Episode
from simpel_cli.filtering.measurements.integration_steps import MOST, TOLERANCE, substeps_needed
from simulators.effects import Scales
from simulators.model import Declared
from simulators.worlds.rk4 import RK4

DT, W = 0.1, 6.0
MODEL = Declared(
    "spring", dt=DT,
    states={"s": {"unit": "m", "range": [-1, 1]}, "v": {"unit": "m/s", "range": [-6, 6]}},
    parameters={"k": {"unit": "1/s^2", "range": [30, 42]}},
    dynamics={"s": "v", "v": "-k*s"},
).model()  # fmt: skip
TIME = np.arange(60) * DT
STATES = np.stack([np.cos(W * TIME), -W * np.sin(W * TIME)], axis=1)
EPISODES = [Episode("0", TIME, STATES, np.zeros((60, 0)), np.zeros((60, 0)))]


def needed(noise: float, rate: float = 0.0) -> int:
    scales = Scales({"s": 1.0, "v": W}, {"s": W, "v": rate}, DT)
    return substeps_needed(MODEL, EPISODES, {"s": noise, "v": W * noise}, scales, np.array([W**2]))


@pytest.mark.parametrize("noise", [1e-1, 1e-3, 1e-5])
def test_no_coarser_than_the_sensors_and_no_finer(noise: float) -> None:
    def missed(steps: int) -> float:
        after = RK4(replace(MODEL, substeps=steps)).step(STATES[:-1], np.zeros((59, 0)), np.full((59, 1), W**2))
        return float(np.quantile(np.abs(after - STATES[1:]).max(axis=1, initial=0, where=[True, False]), 0.99))

    steps = needed(noise)
    assert missed(steps) < 1.2 * TOLERANCE * noise or steps == MOST
    assert steps == 1 or missed(steps - 1) > 0.5 * TOLERANCE * noise
    assert needed(1e-1) < needed(1e-5)


def test_a_force_that_may_switch_within_a_row_asks_for_two() -> None:
    assert (needed(1e-1), needed(1e-1, rate=1e3)) == (1, 2)
