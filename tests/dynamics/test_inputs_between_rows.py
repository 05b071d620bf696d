"""Inputs between rows: every integrator agrees with a fine one, held or linear, late, lagged or prompt."""

import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from simpel_cli.dynamics.transition import encoding_of, transition
from simulators.model import Declared, Model, ModelError
from simulators.step import one_step
from simulators.worlds.rk4 import RK4

DT, ROWS = 0.1, 5
DELAYS = {"prompt": 0.0, "a part of a row": 0.037, "more than a row": 0.137}


def swing(between: dict[str, str], delay: float = 0.0, lag: float | None = None) -> Model:
    """A pendulum with two inputs, the second one held or linear as well."""
    times = ({"delay": delay} if delay else {}) | ({"lag": lag} if lag is not None else {})
    return Declared(
        "swing", dt=DT, substeps=10,
        states={"phi": {"range": [-2, 2]}, "omega": {"range": [-8, 8]}},
        inputs={n: {"range": [-3, 3], "between_rows": between[n], **(times if n == "u" else {})} for n in ("u", "w")},
        dynamics={"phi": "omega", "omega": "-9.81*sin(phi) - 0.2*omega + u*cos(phi) + 0.3*w"},
    ).model()  # fmt: skip


def fine(model: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The last transition by scipy, the inputs as their definition has them: rows at 0, dt, ...; the first one stood before."""
    rows = np.arange(len(u)) * model.dt
    begin, rhs = rows[-2], model.function()

    def given(i: int, t: float) -> float:
        if i in model.linear:
            return float(np.interp(t, rows, u[:, i]))
        return float(u[np.clip(int(np.floor(t / model.dt + 1e-12)), 0, len(u) - 2), i])

    late = [float(model.delay.get(q.name, 0.0)) for q in model.inputs]
    lags = [model.lag.get(q.name) for q in model.inputs]

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        raw = [given(i, t - late[i]) for i in range(len(late))]
        own = [raw[i] if lags[i] is None else z[2 + i] for i in range(len(late))]
        slow = [0.0 if lags[i] is None else (raw[i] - z[2 + i]) / float(lags[i]) for i in range(len(late))]
        return np.concatenate([np.asarray(rhs(z[:2], own, [])[0]).ravel() * (t >= begin), slow])

    kinks = np.unique(np.concatenate([[0.0], *[rows + d for d in late], [begin, begin + model.dt]]))
    kinks = kinks[kinks <= begin + model.dt + 1e-12]
    z = np.concatenate([x, u[0]])
    for a, b in pairwise(kinks):
        # just inside: what jumps at an end belongs to one side of it
        z = solve_ivp(
            lambda t, z, a=a, b=b: rate(np.clip(t, a + 1e-9, b - 1e-9), z), (a, b), z, rtol=1e-11, atol=1e-12
        ).y[:, -1]
    return z[:2]


def by_jax(model: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The last transition as a fit has it."""
    encoding = encoding_of(model, stack=ROWS - 1)
    point = encoding.to_x(x, encoding.stacked(u if encoding.linear else u[:-1]))
    step = transition(model, encoding).step
    with jax.enable_x64(True):
        return x + np.asarray(jax.jit(step)(jnp.asarray(point), jnp.zeros(0)))


def by_casadi(model: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The last transition as it is exported."""
    past = u[-2 - model.past() : -1].ravel()
    return np.asarray(one_step(model)(x, np.concatenate([past, u[-1, list(model.linear)]]), [])[0]).ravel()


def by_rk4(model: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The last transition as it is simulated."""
    return RK4(model).follow(x[None], u[None, :-1], np.zeros((1, 0)), u[None, -1])[0]


def errors(model: Model, way) -> float:
    random, worst = np.random.default_rng(0), 0.0
    scale = np.array([q.high - q.low for q in model.states])
    for _ in range(5):
        x = random.uniform([q.low for q in model.states], [q.high for q in model.states])
        u = random.uniform(-3, 3, (ROWS + 1, 2))
        worst = max(worst, float(np.max(np.abs(way(model, x, u) - fine(model, x, u)) / scale)))
    return worst


@pytest.mark.parametrize("between", [("held", "held"), ("linear", "linear"), ("linear", "held")])
@pytest.mark.parametrize("way", [by_jax, by_casadi, by_rk4])
def test_every_integrator_agrees_with_a_fine_one(between: tuple[str, str], way) -> None:
    assert errors(swing(dict(zip("uw", between, strict=True))), way) < 1e-6


@pytest.mark.parametrize("delay", DELAYS.values(), ids=DELAYS)
@pytest.mark.parametrize("way", [by_jax, by_casadi, by_rk4])
def test_a_linear_input_that_is_late_agrees_as_well(delay: float, way) -> None:
    assert errors(swing({"u": "linear", "w": "held"}, delay), way) < 1e-6


def test_a_linear_input_that_lags_agrees_as_well() -> None:
    model = swing({"u": "linear", "w": "held"}, 0.037, 0.02)
    assert errors(model, by_jax) < 1e-5  # within a substep an exponential is taken for a straight line
    assert errors(replace(model, substeps=40), by_jax) < 1e-6


def test_what_is_exported_has_the_lag_of_a_fit() -> None:
    """Both look back three time constants, no further."""
    model = swing({"u": "linear", "w": "held"}, 0.037, 0.02)
    u = np.random.default_rng(0).uniform(-3, 3, (model.past() + 2, 2))
    x = np.array([0.3, -0.2])
    encoding = encoding_of(model, stack=model.past())
    with jax.enable_x64(True):
        point = jnp.asarray(encoding.to_x(x, encoding.stacked(u)))
        assert np.allclose(
            x + transition(model, encoding).step(point, jnp.zeros(0)), by_casadi(model, x, u), atol=1e-12
        )


def test_the_code_in_c_agrees(tmp_path, monkeypatch) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    monkeypatch.chdir(tmp_path)
    model = swing({"u": "linear", "w": "held"})
    step = one_step(model)
    step.generate("step.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "step.c", "-o", "step.so"], check=True)
    compiled = casadi.external(step.name(), str(tmp_path / "step.so"))
    x, u = np.array([0.3, -0.2]), np.array([1.0, -2.0, 2.5])  # of u: now; then w; then u at the next row
    assert np.allclose(np.asarray(compiled(x, u, [])[0]), np.asarray(step(x, u, [])[0]), atol=1e-14)


def test_a_word_that_is_none_is_refused() -> None:
    with pytest.raises(
        ModelError, match=r"sim.inputs.u.between_rows: 'lineare' is not allowed, only held or linear or smooth"
    ):
        swing({"u": "lineare", "w": "held"})
