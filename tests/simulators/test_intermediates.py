"""Intermediates of a declared simulator: a double pendulum against its mass matrix, and what can be written wrong."""

from typing import Any

import numpy as np
import pytest

from simulators.model import Declared, ModelError

# below the expressions that use them stand some that they use: the order is free
DOUBLE = {
    "name": "double_pendulum",
    "dt": 0.01,
    "states": {
        "a": {"unit": "rad", "range": [-3, 3]},
        "b": {"unit": "rad", "range": [-3, 3]},
        "wa": {"unit": "rad/s", "range": [-4, 4]},
        "wb": {"unit": "rad/s", "range": [-4, 4]},
    },
    "inputs": {"u": {"unit": "N m", "range": [-1, 1]}},
    "parameters": {
        "m": {"unit": "kg", "range": [0.5, 2]},
        "n": {"unit": "kg", "range": [0.5, 2]},
        "l": 0.7,
        "r": 1.1,
        "g": 9.81,
        "both": "m + n",
    },
    "intermediates": {
        "first": "(u + push_a - coupling*second)/inertia",
        "second": {
            "unit": "rad/s^2",
            "expression": "(push_b - coupling/inertia*(u + push_a))/(n*r**2 - coupling**2/inertia)",
        },
        "inertia": {"unit": "kg m^2", "expression": "both*l**2"},
        "coupling": "n*l*r*cos(apart)",
        "push_a": "-n*l*r*wb**2*sin(apart) - both*g*l*sin(a)",
        "push_b": "n*l*r*wa**2*sin(apart) - n*g*r*sin(b)",
        "apart": "a - b",
        "energy": "inertia*wa**2/2 + n*r**2*wb**2/2 + coupling*wa*wb - both*g*l*cos(a) - n*g*r*cos(b)",
    },
    "dynamics": {"a": "wa", "b": "wb", "wa": "first", "wb": "second"},
    "outputs": {"E": {"unit": "J", "expression": "energy"}, "share": "push_a/push_b"},
}  # fmt: skip


def test_a_double_pendulum() -> None:
    model = Declared(**DOUBLE).model()
    function = model.function()
    random = np.random.default_rng(1)
    l, r, g = 0.7, 1.1, 9.81  # noqa: E741
    for _ in range(20):
        a, b, wa, wb = random.uniform(-3, 3, 4)
        m, n = random.uniform(0.5, 2, 2)
        u = random.uniform(-1, 1)
        mass = np.array([[(m + n) * l**2, n * l * r * np.cos(a - b)], [n * l * r * np.cos(a - b), n * r**2]])
        push = np.array([
            u - n * l * r * wb**2 * np.sin(a - b) - (m + n) * g * l * np.sin(a),
            n * l * r * wa**2 * np.sin(a - b) - n * g * r * np.sin(b),
        ])  # fmt: skip
        rates, outputs = (np.asarray(part).ravel() for part in function([a, b, wa, wb], u, [m, n]))
        np.testing.assert_allclose(rates, [wa, wb, *np.linalg.solve(mass, push)], rtol=1e-9, atol=1e-9)
        w = np.array([wa, wb])
        energy = w @ mass @ w / 2 - (m + n) * g * l * np.cos(a) - n * g * r * np.cos(b)
        np.testing.assert_allclose(outputs, [energy, (push[0] - u) / push[1]], rtol=1e-9, atol=1e-9)


def changed(**intermediates: Any) -> dict[str, Any]:
    return DOUBLE | {"intermediates": DOUBLE["intermediates"] | intermediates}


WRONG = [
    ({"apart": "a - energy"}, "sim.intermediates: derived in a circle, "),
    ({"apart": "apart"}, "apart -> apart; write one of them without the others"),
    ({"apart": "a - bb"}, "sim.intermediates.apart: unknown name 'bb'"),
    ({"apart": "a -"}, "sim.intermediates.apart: this is not a formula"),
    ({"apart": {"unit": "rad"}}, "sim.intermediates.apart: no expression; add `expression: <formula>`"),
    ({"apart": {"expression": "a - b", "range": [0, 1]}}, "sim.intermediates.apart.range: unknown key"),
    ({"apart": {"expression": "a - b", "unit": 1}}, "sim.intermediates.apart.unit: 1 is not a text"),
    ({"apart": ["a"]}, "sim.intermediates.apart: ['a'] is no expression"),
    ({"m": "2"}, "sim.intermediates.m: the name is taken by sim.parameters.m"),
    ({"sin": "2"}, "sim.intermediates.sin: sin is a function of expressions"),
    ({"a b": "2"}, "sim.intermediates: 'a b' is no name"),
]


@pytest.mark.parametrize(("intermediates", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_wrong_ones_are_refused(intermediates: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        Declared(**changed(**intermediates)).model()
    assert message in str(caught.value)


def test_a_parameter_is_not_derived_from_them() -> None:
    content = DOUBLE | {"parameters": DOUBLE["parameters"] | {"both": "m + apart"}}
    with pytest.raises(ModelError, match=r"sim.parameters.both: uses apart, which is no parameter"):
        Declared(**content).model()


def test_none_are_needed() -> None:
    with pytest.raises(ModelError, match=r"sim.intermediates: None is not a mapping"):
        Declared(**DOUBLE | {"intermediates": None}).model()
