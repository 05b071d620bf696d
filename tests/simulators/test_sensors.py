"""Sensors of a declared simulator: scale, bias, ends and lag against closed forms; what can be written wrong."""

import math
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
import yaml

from simpel_cli.dynamics.casadi_jax import checked
from simulators.effects import structure
from simulators.extended import Extended
from simulators.model import Declared, Model, ModelError
from simulators.racecar import RaceCar
from simulators.step import one_step


def tank(**sensor: Any) -> dict[str, Any]:
    return {
        "name": "tank",
        "dt": 0.5,
        "states": {"h": {"unit": "m", "range": [0, 4]}},
        "inputs": {"q": {"unit": "m/s", "range": [-1, 1]}},
        "parameters": {
            "gain": {"range": [2, 3]},
            "zero": 0.5,
            "tau": {"unit": "s", "range": [0.4, 2]},
            "half": "gain/2",
        },
        "dynamics": {"h": "q"},
        "outputs": {
            "plain": "2*h",
            "volts": {"unit": "V", "expression": "h", "scale": "gain", "bias": "zero", **sensor},
        },
    }


def read(model: Model, h: float) -> list[float]:
    return np.asarray(model.function()(h, 0, [2.5, 1])[1]).ravel().tolist()


def test_scale_and_bias() -> None:
    assert read(Declared(**tank()).model(), 2) == [4, 5.5]
    assert read(Declared(**tank(scale=-3, bias="2*pi")).model(), 2) == [4, pytest.approx(2 * math.pi - 6)]
    assert read(Declared(**tank(scale="half")).model(), 2) == [4, 3]


@pytest.mark.parametrize(
    ("ends", "kept", "readings"),
    [
        ([1, 6], (1, 6), [1, 3, 6]),
        ([None, 6], (-math.inf, 6), [0.5, 3, 6]),
        ([1, None], (1, math.inf), [1, 3, 10.5]),
        ([None, None], None, [0.5, 3, 10.5]),
    ],
)
def test_a_reading_stays_within_its_ends(ends: list, kept: tuple | None, readings: list[float]) -> None:
    model = Declared(**tank(saturates=ends)).model()
    assert model.saturation == ({} if kept is None else {"volts": kept})
    assert [read(model, h)[1] for h in (0, 1, 4)] == readings
    assert [read(model, h)[0] for h in (0, 1, 4)] == [0, 2, 8]  # the other output has no ends
    checked(model.function(), [[(0.0, 4.0)], [(-1.0, 1.0)], [(2.0, 3.0), (0.4, 2.0)]])


@pytest.mark.parametrize("lag", ["tau", 0.8])
def test_a_lagging_reading_is_a_state_that_follows(lag: str | float) -> None:
    model = Declared(**tank(lag=lag, range=[0, 12], saturates=[1, 6])).model()
    assert [q.name for q in model.states] == ["h", "volts"]
    assert (model.states[1].unit, model.states[1].low, model.states[1].high) == ("V", 0, 12)
    assert [q.name for q in model.outputs] == ["plain"]
    assert model.saturation == {"volts": (1, 6)}
    step, level, reading = one_step(model), 3.0, 2.0
    for i in range(1, 6):
        level, reading = np.asarray(step([level, reading], 0, [2.5, 0.8])[0]).ravel()
        # it goes to 2.5*3 + 0.5 = 8, beyond the end of 6, at which only what is measured of it is cut
        assert reading == pytest.approx(8 + (2 - 8) * math.exp(-0.5 * i / 0.8), abs=1e-6)
    assert reading > 6.5
    assert structure(model).dynamic == ("h",)  # no force acts on a reading
    extended = Extended(
        "more", Declared(**tank(lag=lag, range=[0, 12], saturates=[1, 6])), dynamics={"h": "-h"}
    ).model()
    assert (extended.saturation, extended.states) == (model.saturation, model.states)


def test_of_a_static_function() -> None:
    outputs = {"y": {"expression": "u", "lag": 0.2, "range": [0, 1]}, "z": "2*u"}
    model = Declared("static", 0.1, inputs={"u": {"range": [0, 1]}}, outputs=outputs).model()
    rates, prompt = model.function()(0.25, 1, [])
    assert (float(rates), float(prompt)) == (pytest.approx(0.75 / 0.2), 2)
    del outputs["z"]
    assert Declared("static", 0.1, inputs={"u": {"range": [0, 1]}}, outputs=outputs).model().function().size_out(1) == (
        0,
        1,
    )


def test_beside_coordinates_of_its_own() -> None:
    """What is integrated in the car's frame has the rates that are declared in the world's: the chain rule."""
    node = yaml.safe_load((Path(__file__).parents[2] / "conf" / "sim" / "racecar.yaml").read_text())
    del node["_target_"]
    node["outputs"] = {
        "speed": {"expression": "vx", "scale": 2, "lag": 0.3, "range": [-9, 9]},
        "turn": "theta",
        "gyro": {"expression": "omega", "lag": 0.1, "range": [-9, 9]},
    }
    model = RaceCar(**node).model()
    flow = model.flow()
    assert [q.name for q in model.states][6:] == ["speed", "gyro"]
    x, u = [0.1, 0.2, 0.3, 1.5, 0.4, 0.7, 2.0, -1.0], [0.2, 0.6]
    p = [q.middle for q in model.params]
    z = flow.enter(x, p)
    np.testing.assert_allclose(flow.leave(z, p).full().ravel(), x, atol=1e-12)
    rates, outputs = model.function()(x, u, p)
    slope = casadi.Function("slope", [zs := casadi.MX.sym("z", 8)], [casadi.jacobian(flow.leave(zs, p), zs)])
    np.testing.assert_allclose((slope(z) @ flow.rhs(z, u, p)).full(), rates.full(), atol=1e-9)
    np.testing.assert_allclose(rates.full().ravel()[6:], [(2 * 1.5 - 2) / 0.3, (0.7 + 1) / 0.1])
    assert float(outputs) == 0.3


WRONG = [
    ({"scale": "gan"}, "sim.outputs.volts.scale: 'gan' is neither a number nor a parameter; known: gain, zero, tau, half. Did"),
    ({"scale": "h"}, "sim.outputs.volts.scale: 'h' is neither a number nor a parameter"),
    ({"bias": None}, "sim.outputs.volts.bias: None is not a number"),
    ({"bias": "2*h"}, "sim.outputs.volts.bias: unknown name 'h'"),
    ({"saturates": [6, 1]}, "sim.outputs.volts.saturates: low = 6 is not below high = 1"),
    ({"saturates": 6}, "sim.outputs.volts.saturates: 6 is not allowed; write [low, high], null for no limit"),
    ({"saturates": ["gain", 6]}, "sim.outputs.volts.saturates: unknown name 'gain'"),
    ({"lag": 1}, "sim.outputs.volts: no range; a lagging reading is a state of its own: add `range: [low, high]`"),
    ({"lag": 0, "range": [0, 1]}, "sim.outputs.volts.lag: 0 s is not allowed; give a positive time constant"),
    ({"lag": 0.01, "range": [0, 1]}, "sim.outputs.volts.lag: 0.01 s is shorter than half a Runge-Kutta step (dt/subst"),
    ({"lag": "q", "range": [0, 1]}, "sim.outputs.volts.lag: 'q' is neither a number nor a parameter"),
    ({"lag": 1, "range": [1, 0]}, "sim.outputs.volts.range: low = 1 is not below high = 0"),
    ({"range": [0, 1]}, "sim.outputs.volts.range: an output without a lag is no state and has no range; leave it out"),
    ({"gain": 2}, "sim.outputs.volts.gain: unknown key; allowed: unit, expression, scale, bias, saturates, lag, range"),
]  # fmt: skip


@pytest.mark.parametrize(("sensor", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_wrong_sensors_are_refused(sensor: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        Declared(**tank(**sensor)).model()
    assert message in str(caught.value)
