"""A linear plant, dv/dt = B u - A v + load, ds/dt = v, exactly integrated, and an effect that may be its load."""

from typing import Any

import numpy as np

from simpel_cli.data.recording import Check, Episode, Recording
from simulators.effects import Expression
from simulators.model import Declared

DT, ROWS, A, B = 0.2, 12, 0.7, 1.3
LOAD = Expression("load", acts_on="v", term="c", parameters={"c": {"range": [-1, 1], "unit": "A", "starts": [0.1]}})


def recording(seed: int = 0, noise: float = 0.05, load: float = 0.0) -> Recording:
    """Episodes of dv/dt = B u - A v + load, ds/dt = v, exactly integrated."""
    random = np.random.default_rng(seed)
    episodes = []
    for k in range(5):
        u = random.normal(size=ROWS)
        s, v, states = 0.0, random.normal(), []
        for i in range(ROWS):
            states.append([s, v])
            end = (B * u[i] + load) / A
            s += end * DT + (v - end) * (1 - np.exp(-A * DT)) / A
            v = end + (v - end) * np.exp(-A * DT)
        measured = np.array(states) + noise * random.normal(size=(ROWS, 2))
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, measured, u[:, None], np.zeros((ROWS, 0))))
    return Recording(
        tuple(episodes[:4]), tuple(episodes[4:]), (), {"s": noise, "v": noise}, (), (Check("c", True, ""),), ()
    )


def model() -> Any:
    return Declared(
        "hypothesis", dt=DT,
        states={"s": {"unit": "m", "range": [-3, 3]}, "v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}},
        parameters={"a": {"unit": "1/s", "range": [0.2, 1.2]}, "b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": "b*u - a*v"},
    ).model()  # fmt: skip
