"""Limits of states and coordinates of a model's own: applied after a Runge-Kutta step, in numpy and in JAX."""

import casadi
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_node

from simpel_cli.config.build import build
from simpel_cli.dynamics.transition import encoding_of, transition
from simulators.model import Coordinates, Declared, Model, ModelError, Quantity
from simulators.worlds.rk4 import RK4


def tank(limits: list[float | None] | None, substeps: int = 1) -> Model:
    """A level that falls at a constant rate, and the volume that flowed: out of an empty tank as well, unless it is limited."""
    level = {"unit": "m", "range": [0, 1]} | ({"limits": limits} if limits is not None else {})
    return Declared(
        "tank", dt=1.0, substeps=substeps, states={"h": level, "q": {"unit": "m", "range": [0, 1]}},
        dynamics={"h": "-0.6", "q": "0.6 + h"},
    ).model()  # fmt: skip


def step(model: Model, state: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """One transition by both integrators."""
    numpy = RK4(model).step(np.array([state]), np.zeros((1, len(model.inputs))), np.zeros((1, 0)))[0]
    x = jnp.asarray(encoding_of(model).to_x(np.array(state), np.zeros(len(model.inputs))))
    return numpy, np.asarray(x + transition(model, encoding_of(model)).step(x, jnp.zeros(0)))


def test_limits_act_after_a_step_and_not_inside_it() -> None:
    free, limited = step(tank(None), [0.4, 0.0]), step(tank([0, None]), [0.4, 0.0])
    for one, other in zip(free, limited, strict=True):
        np.testing.assert_allclose(one, [-0.2, 0.7])
        np.testing.assert_allclose(other, [0.0, 0.7])  # the level that q saw went below 0 within the step
    twice = step(tank([0, None], substeps=2), [0.2, 0.0])
    # first half: 0.2 -> -0.1 -> 0, q grows by 0.3 + mean level 0.05/2; second half: 0 -> -0.3 -> 0
    for one in twice:
        np.testing.assert_allclose(one, [0.0, 0.3 + 0.5 * 0.05 + 0.3 - 0.5 * 0.15], atol=1e-12)


def test_both_ends() -> None:
    for one in step(tank([0.1, 0.15]), [0.9, 0.0]):
        assert one[0] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ([1, 0], r"sim\.states\.h\.limits: low = 1 is not below high = 0; swap or widen them"),
        ([1], r"sim\.states\.h\.limits: \[1\] is not allowed; write \[low, high\], null for no limit"),
    ],
)
def test_limits_upside_down(limits: list[float | None], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        tank(limits)


def test_an_angle_has_no_limits() -> None:
    angle = {"unit": "rad", "range": [-3, 3], "periodic": True, "limits": [0, 1]}
    with pytest.raises(ModelError, match=r"sim\.states\.a\.limits: a periodic state has no ends"):
        Declared("turn", dt=0.1, states={"a": angle}, dynamics={"a": "1"}).model()


def logarithmic(limits: tuple[float, float] = (-np.inf, np.inf)) -> Model:
    """x' = -x, integrated as z = log x, z' = -1, which every Runge-Kutta step solves exactly."""
    return Model(
        name="log", dt=2.0, substeps=1, states=(Quantity("x", "1", 0.5, 2.0),), inputs=(), params=(), outputs=(),
        rhs=lambda x, u, p: -x, output=lambda x, u, p: casadi.SX(0, 1),
        coordinates=Coordinates(
            1, lambda x, p: casadi.log(x), lambda z, u, p: -casadi.SX.ones(1), lambda z, p: casadi.exp(z), limits
        ),
    )  # fmt: skip


def test_a_model_is_integrated_in_its_own_coordinates() -> None:
    for one in step(logarithmic(), [1.5]):
        np.testing.assert_allclose(one, [1.5 * np.exp(-2)], rtol=1e-12)
    for one in step(logarithmic((-1.0, 3.0)), [1.5]):
        np.testing.assert_allclose(one, [np.exp(-1)], rtol=1e-12)


def test_states_that_are_not_integrated_have_no_limits() -> None:
    node = whole_node("racecar")
    node["states"]["vx"]["limits"] = [-1, 1]
    with pytest.raises(ModelError, match=r"sim\.states\.vx\.limits: RaceCar is not integrated in its states"):
        build(node, "sim").model()
