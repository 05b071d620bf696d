"""Transitions of what late sensors show, against readings of a linear system that are computed finely."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from simpel_cli.dynamics.arriving import arriving
from simpel_cli.dynamics.casadi_jax import to_jax
from simpel_cli.dynamics.input_delay import as_read
from simpel_cli.dynamics.late_readings import behind, late_of
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simulators.model import Declared

DT, FINE = 0.1, 200


def swing(sensors: dict[str, Any], between_rows: str = "held") -> Declared:
    return Declared(
        "swing",
        DT,
        states={"s": {"range": [-2, 2]}, "v": {"range": [-4, 4]}},
        inputs={"u": {"range": [-1, 1], "between_rows": between_rows}},
        dynamics={"s": "v", "v": "-4*s - 0.6*v + 9*u"},
        outputs={"pull": "2*s - v"},
        sensors=sensors,
    )


def readings(
    sensor: str, tau: float, d: float, u: np.ndarray, *, linear: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return states at rows, and what a sensor shows there: the lag as a state of its own, and an earlier value."""
    h, size = DT / FINE, 4 if tau else 3
    a = np.zeros((size, size))
    a[0, 1], a[1, :3] = 1, (-4, -0.6, 9)
    of = {"s": [1, 0], "v": [0, 1], "pull": [2, -1]}[sensor]
    if tau:
        a[3, :2], a[3, 3] = np.array(of) / tau, -1 / tau
    step = expm(h * a)
    x, rows = np.zeros(size), []
    x[0] = 1.0
    if tau:
        x[3] = np.dot(of, x[:2])
    for k in range(len(u) * FINE):
        row, part = divmod(k, FINE)
        next_u = u[min(row + 1, len(u) - 1)]
        x[2] = u[row] + (part + 0.5) / FINE * (next_u - u[row]) if linear else u[row]
        rows.append(x.copy())
        x = step @ x
    every = np.array(rows)
    seen = every[:, 3] if tau else every[:, :2] @ np.array(of)
    at = np.arange(len(u)) * FINE
    return every[at, :2], seen[np.maximum(at - round(d / h), 0)]


@pytest.mark.parametrize(
    ("sensor", "tau", "d", "between_rows"),
    [
        *((sensor, *late, "held") for sensor in ("s", "v", "pull") for late in ((0.05, 0.0), (0.0, 0.15))),
        ("s", 0.05, 0.0, "linear"),
        ("v", 0.0, 0.05, "linear"),
    ],
)
def test_the_next_reading(sensor: str, tau: float, d: float, between_rows: str) -> None:
    u = np.random.default_rng(0).uniform(-1, 1, 60) if between_rows == "held" else np.sin(0.05 * np.arange(60) ** 1.4)
    states, seen = readings(sensor, tau, d, u, linear=between_rows == "linear")
    errors = {}
    for kind in ("late", "prompt"):
        sensors = {sensor: ({"lag": tau} if tau else {}) | ({"delay": d} if d else {})} if kind == "late" else {}
        model = swing(sensors, between_rows).model()
        encoding = encoding_of(model, ("pull",), stack=2)
        step = jax.jit(jax.vmap(transition(model, encoding).step, in_axes=(0, None)))
        read = np.concatenate([states, (2 * states[:, :1] - states[:, 1:])], axis=1)
        read[:, ["s", "v", "pull"].index(sensor)] = seen
        k = np.arange(8, len(u) - 1)
        past = np.stack([u[k - 2], u[k - 1], u[k]], axis=1)
        past = np.concatenate([past, u[k + 1, None]], axis=1) if between_rows == "linear" else past
        y = np.asarray(step(jnp.asarray(np.concatenate([read[k, :2], past], axis=1)), jnp.zeros(0)))
        known = np.concatenate([read[k + 1, :2] - read[k, :2], read[k, 2:]], axis=1)
        errors[kind] = np.sqrt(np.mean((y - known) ** 2, axis=0))
    late, prompt = errors["late"], errors["prompt"]
    column = ["s", "v", "pull"].index(sensor)
    assert late[column] < 0.2 * prompt[column], (late, prompt)
    assert (late <= 1.05 * prompt + 1e-9).all(), (late, prompt)


@pytest.mark.parametrize("kind", ["lag", "delay"])
def test_what_is_left_is_of_the_fourth_order_along_a_free_motion(kind: str) -> None:
    """Both directions are of the same series, so what is left is its next term."""
    errors = []
    for late in (0.1, 0.05):
        states, seen = readings("s", late if kind == "lag" else 0.0, late if kind == "delay" else 0.0, np.zeros(80))
        model = swing({"s": {kind: late}}).model()
        step = transition(model, encoding_of(model, stack=3)).step
        x = np.concatenate([seen[40:-1, None], states[40:-1, 1:], np.zeros((39, 4))], axis=1)
        y = np.asarray(jax.jit(jax.vmap(step, in_axes=(0, None)))(jnp.asarray(x), jnp.zeros(0)))
        errors.append(np.abs(y[:, 0] - np.diff(seen[40:])).max())
    assert 12 < errors[0] / errors[1] < 24


def test_the_rows_of_an_episode() -> None:
    u = np.random.default_rng(0).uniform(-1, 1, 40)
    for sensor, column in (("v", 1), ("pull", 2)):
        states, seen = readings(sensor, 0.05, 0.0, u)
        prompt = np.concatenate([states, 2 * states[:, :1] - states[:, 1:]], axis=1)[:, column]
        shown = behind(swing({sensor: {"lag": 0.05}}).model(), states, u[:, None], np.zeros(0))
        assert np.abs(prompt + shown[:, column] - seen)[6:].max() < 0.1 * np.abs(prompt - seen)[6:].max()
        assert not shown[:, [i for i in range(3) if i != column]].any()


def test_past_inputs_are_asked_for() -> None:
    model = swing({"v": {"lag": 0.05}}).model()
    with pytest.raises(
        ConfigError, match=r"late sensors of swing show what inputs did before: .* data.stack_actions=2"
    ):
        transition(model, encoding_of(model, stack=1))


def test_beside_a_late_input() -> None:
    """A delay of whole rows is the same as inputs that are given so much later."""
    sensors = {"v": {"lag": 0.03}}
    prompt, late = swing(sensors).model(), swing(sensors)
    late.inputs["u"]["delay"] = 2 * DT
    x, u = jnp.array([0.3, 0.4]), jnp.array([0.9, -0.2, 0.5, 0.1])
    ahead = transition(prompt, encoding_of(prompt, stack=1)).step(jnp.concatenate([x, u[:2]]), jnp.zeros(0))
    model = late.model()
    behind = transition(model, encoding_of(model, stack=3)).step(jnp.concatenate([x, u]), jnp.zeros(0))
    np.testing.assert_allclose(ahead, behind, rtol=1e-9)


@pytest.mark.parametrize("late", [0.5, 1.5])
def test_an_input_that_arrives_within_a_row_jumps_there(late: float) -> None:
    """A delay of half a row: the same as rows of half the length, whose inputs come in twos, a row of these later."""
    given = swing({"v": {"delay": 1.3 * DT}})
    fine = replace(given, dt=DT / 2, substeps=4).model()
    rows = replace(given, substeps=8, inputs={"u": given.inputs["u"] | {"delay": late * DT}}).model()
    x, u = jnp.array([0.3, 0.4]), jnp.array([0.9, -0.2, 0.5, 0.1, -0.7, 0.3])
    halves = jnp.repeat(u, 2)[: -int(2 * late) or None]
    of_rows = late_of(rows, to_jax(rows.function()))
    of_halves = late_of(fine, to_jax(fine.function()))
    assert of_rows is not None
    assert of_halves is not None
    now = as_read(arriving(rows, u[:, None], jnp.zeros(0), 2), rows.linear)
    found = of_rows.behind(x, now, jnp.zeros(0))
    expected = of_halves.behind(x, jnp.broadcast_to(halves[:, None, None, None], (len(halves), 4, 1, 1)), jnp.zeros(0))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
