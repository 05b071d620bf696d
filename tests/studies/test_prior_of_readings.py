"""Sensors that are planted: the simulator that has them predicts what is measured, one that lacks them does worse."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from simpel_cli.dynamics.transition import encoding_of, transition
from simulators.model import Declared

ROWS, FINE, AHEAD = 90, 40, 15  # rows; steps of a row; rows of a free run
PENDULUM: dict[str, Any] = {
    "name": "pendulum",
    "dt": 0.05,
    "states": {"phi": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}, "omega": {"range": [-9, 9]}},
    "inputs": {"u": {"range": [-2, 2]}},
    "dynamics": {"phi": "omega", "omega": "-9*sin(phi) - 0.3*omega + 4*u"},
}
OVEN: dict[str, Any] = {
    "name": "oven",
    "dt": 4.0,
    "states": {"wall": {"unit": "K", "range": [0, 80]}, "air": {"unit": "K", "range": [0, 80]}},
    "inputs": {"heat": {"range": [0, 2]}},
    "dynamics": {"wall": "2*heat - 0.06*(wall - air)", "air": "0.09*(wall - air) - 0.02*air - 1e-4*air**2"},
}
SENSORS = {
    "bias": {"value": "{name} + b"},
    "scale": {"value": "1.15*{name}"},
    "lag": {"lag": "late"},
    "delay": {"delay": "late"},
}


def recorded(node: dict[str, Any], place: str, kind: str, size: float, late: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what the sensors show at rows, (T, 2), and the inputs, (T, 1): integrated finely, the lag as a state."""
    names, dt = list(node["states"]), node["dt"]
    (low, high) = next(iter(node["inputs"].values()))["range"]
    u = np.repeat(np.random.default_rng(1).uniform(low, high, ROWS // 3), 3)  # steps of three rows
    rates = Declared(**node).model().function()
    x, column = np.array([0.5, 0.0, 0.0]), names.index(place)
    x[2] = x[column]
    fine = [x]
    for row in range(ROWS):

        def rate(_: float, x: np.ndarray, u: float = u[row]) -> np.ndarray:
            follow = (x[column] - x[2]) / late if kind == "lag" else 0.0
            return np.append(np.asarray(rates(x[:2], u, [])[0]).ravel(), follow)

        times = np.linspace(0, dt, FINE + 1)
        fine += list(solve_ivp(rate, (0, dt), fine[-1], t_eval=times[1:], rtol=1e-9, atol=1e-9).y.T)
    every, at = np.array(fine), np.arange(ROWS) * FINE
    seen = every[at, :2]
    if kind == "lag":
        seen[:, column] = every[at, 2]
    elif kind == "delay":
        seen[:, column] = every[np.maximum(at - round(late / dt * FINE), 0), column]
    else:
        seen[:, column] = seen[:, column] + size if kind == "bias" else 1.15 * seen[:, column]
    return seen, u[:, None]


def errors(node: dict[str, Any], seen: np.ndarray, u: np.ndarray, stack: int) -> np.ndarray:
    """Root mean square errors of both columns one row ahead and after a free run, (2, 2)."""
    model = Declared(**node).model()
    encoding = encoding_of(model, stack=stack)
    step = jax.jit(jax.vmap(transition(model, encoding).step, in_axes=(0, None)))
    starts = np.arange(6, ROWS - AHEAD)
    state = jnp.asarray(seen[starts])
    found = []
    for ahead in range(AHEAD):
        now = starts + ahead
        past = np.concatenate([u[now - back] for back in range(stack, -1, -1)], axis=1)
        encoded = encoding.encode(state)
        y = step(jnp.concatenate([encoded, jnp.asarray(past)], axis=1), jnp.zeros(0))
        state = encoding.decode(encoding.advance(encoded, y))
        off = np.asarray(state) - seen[now + 1]
        if model.states[0].periodic:
            off[:, 0] = (off[:, 0] + np.pi) % (2 * np.pi) - np.pi
        found.append(np.sqrt(np.mean(off**2, axis=0)))
    return np.array([found[0], found[-1]])


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize(
    ("node", "place", "size", "late"),
    [(PENDULUM, "omega", 0.8, 0.03), (OVEN, "air", 6.0, 2.5)],
    ids=["pendulum", "oven"],
)
def test_is_better_than_without_them(node: dict[str, Any], place: str, size: float, late: float, kind: str) -> None:
    seen, u = recorded(node, place, kind, size, late)
    of = {key: text.format(name=place) for key, text in SENSORS[kind].items()}
    corrected = node | {"parameters": {"b": size, "late": late}, "sensors": {place: of}}
    before, after = errors(node, seen, u, 2), errors(corrected, seen, u, 2)
    own = list(node["states"]).index(place)
    # a line is exact; what is late is shown to third order
    most = np.full(2, 1e-3 if kind in ("bias", "scale") else 0.3) * before[:, own]
    assert (after[:, own] < most).all(), (before, after)
    assert (after[:, 1 - own] <= 1.05 * before[:, 1 - own] + 1e-9).all(), (before, after)
