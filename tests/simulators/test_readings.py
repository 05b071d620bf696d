"""What sensors show of states and outputs, against the closed form of a linear system; what can be written wrong."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.linalg import expm

from simpel_cli.data.estimation.smoother import speeds
from simulators.extended import Extended
from simulators.groups import grouped
from simulators.model import Declared, Model, ModelError
from simulators.racecar import RaceCar
from simulators.step import one_step

A = np.array([[0.0, 1.0], [-4.0, -0.6]])
B = np.array([0.0, 3.0])


def swing(**parts: Any) -> dict[str, Any]:
    return {
        "name": "swing",
        "dt": 0.1,
        "states": {"s": {"unit": "m", "range": [-2, 2]}, "v": {"unit": "m/s", "range": [-4, 4]}},
        "inputs": {"u": {"range": [-1, 1]}},
        "parameters": {"a": {"range": [-0.5, 0.5]}, "half": "a/2", "b": 0.3},
        "dynamics": {"s": "v", "v": "-4*s - 0.6*v + 3*u"},
        "outputs": {"pull": {"unit": "N", "expression": "4*s"}},
    } | parts


def exact(s: float, v: float, u: float) -> np.ndarray:
    """Return the state 0.1 s later."""
    settled = -np.linalg.solve(A, B) * u
    return np.asarray(settled + expm(0.1 * A) @ (np.array([s, v]) - settled))


def after(model: Model, x: Any, u: float, p: Any) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.asarray(value).ravel() for value in one_step(model)(x, u, p))  # type: ignore[return-value]


SENSORS = {"s": {"value": "s*(1 + a) + b"}, "v": {"value": "2*v"}, "pull": {"value": "pull - half"}}


@pytest.mark.parametrize("where", ["declared", "beside a base", "on those of a base"])
def test_a_transition_of_what_is_read(where: str) -> None:
    node = swing(sensors=SENSORS)
    model = Declared(**node).model()
    if where == "beside a base":
        free = Declared(**swing(dynamics={"s": "v", "v": "-4*s + 3*u"}))
        more = {"half_a": {"range": [-0.25, 0.25]}}
        of = {**SENSORS, "pull": {"value": "pull - half_a"}}
        model = Extended("more", free, more, dynamics={"v": "-0.6*v"}, sensors=of).model()
    if where == "on those of a base":
        node["sensors"] = SENSORS | {"s": {"value": "s*(1 + a)"}}
        model = Extended("more", Declared(**node), sensors={"s": {"value": "s + b"}}).model()
    a, u, true = 0.2, 0.7, np.array([0.5, -1.2])
    p = [a, a / 2][: len(model.params)]
    read, output = after(model, [1.2 * true[0] + 0.3, 2 * true[1]], u, p)
    s, v = exact(*true, u)
    np.testing.assert_allclose(read, [1.2 * s + 0.3, 2 * v], rtol=1e-8)
    assert output == pytest.approx(4 * true[0] - 0.1)
    assert model.echoes() == 0
    # what the speed's sensor shows is not the rate of what the position's shows, unless both have the same factor
    assert speeds(model) == {}
    same = swing(sensors={"s": {"value": "s*(1 + a) + b"}, "v": {"value": "v*(1 + a)"}})
    assert speeds(Declared(**same).model()) == {"v": ["s"]}


def test_limits_are_those_of_the_state() -> None:
    node = swing(dynamics={"s": "-1", "v": "2"}, sensors={"s": {"value": "2*s + b"}})
    node["states"] = {"s": {"range": [0, 2], "limits": [0, None]}, "v": {"range": [-4, 4], "limits": [None, 0.05]}}
    model = Declared(**node).model()
    np.testing.assert_allclose(after(model, [2 * 0.04 + 0.3, 0.0], 0, [0])[0], [0.3, 0.05])
    np.testing.assert_allclose(after(model, [2 * 0.5 + 0.3, -1.0], 0, [0])[0], [2 * 0.4 + 0.3, -0.8])


def test_with_coordinates_of_its_own() -> None:
    node = yaml.safe_load((Path(__file__).parents[2] / "conf" / "sim" / "racecar.yaml").read_text())
    del node["_target_"]
    plain = RaceCar(**node).model()
    seen = RaceCar(**node, sensors={"vx": {"value": "1.1*vx + 0.2"}}).model()
    x, u = np.array([0.1, 0.2, 0.3, 1.5, 0.4, 0.7]), [0.2, 0.6]
    p = [q.middle for q in plain.params]

    def shown(x: np.ndarray) -> np.ndarray:
        return np.array([1.1 * v + 0.2 if i == 3 else v for i, v in enumerate(x)])

    u = u * (plain.past() + 1)
    np.testing.assert_allclose(
        np.asarray(one_step(seen)(shown(x), u, p)[0]).ravel(),
        shown(np.asarray(one_step(plain)(x, u, p)[0]).ravel()),
        rtol=1e-9,
    )


def test_an_offset_that_differs_from_rig_to_rig() -> None:
    node = swing(sensors={"s": {"value": "s + a"}})
    node["parameters"]["a"] = {"range": [-0.5, 0.5], "per": "rig"}
    model = grouped(Declared(**node).model(), {"rig": ("one", "two")})
    names = [q.name for q in model.params]
    p = np.zeros(len(names))
    p[names.index("a")], p[names.index("a_spread")], p[names.index("a_of_two")] = 0.1, 0.2, 1.5
    s, v = exact(0.5, 1.0, 0.4)
    for rig, offset in enumerate([0.1, 0.4]):
        slots = np.eye(3)[rig]
        read = np.asarray(one_step(model)([0.5 + offset, 1.0], [0.4, *slots], p)[0]).ravel()
        np.testing.assert_allclose(read, [s + offset, v], rtol=1e-8)


def test_how_far_back_a_late_sensor_shows() -> None:
    late = Declared(**swing(sensors={"s": {"lag": "b", "delay": 0.02}, "v": {"delay": 0.11}})).model()
    assert (late.sensor_lag, late.sensor_delay) == ({"s": "b"}, {"s": 0.02, "v": 0.11})
    assert (late.past(), late.echoes()) == (0, 11)  # 0.11 s and three times 0.3 s
    free = swing(sensors={"s": {"lag": "b"}}, inputs={}, dynamics={"s": "v", "v": "-4*s"})
    assert Declared(**free).model().echoes() == 0  # nothing acts that could be shown late


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ({"pul": {"delay": 0.1}}, "sim.sensors.pul: is neither a state nor an output; known: s, v, pull. Did you mean"),
        ({"s": {"scale": 2}}, "sim.sensors.s.scale: unknown key; allowed: value, delay, lag"),
        ({"s": {"value": "s**2"}}, "sim.sensors.s.value: 's\\*\\*2' is no line in s"),
        ({"s": {"value": "b"}}, "sim.sensors.s.value: 'b' is no line in s"),
        ({"s": {"value": "s + v"}}, "sim.sensors.s.value: unknown name 'v'; known here: a, b, half, s"),
        ({"s": {"lag": "tau"}}, "sim.sensors.s.lag: 'tau' is neither a number"),
        ({"s": {"delay": -0.1}}, "sim.sensors.s.delay: -0.1 s is negative; nothing is shown before it happens"),
        ({"s": "s + b"}, "sim.sensors.s: 's \\+ b' is not a mapping"),
    ],
)
def test_what_can_be_written_wrong(sensors: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Declared(**swing(sensors=sensors)).model()


def test_what_is_late_already_and_what_groups_cannot_change() -> None:
    late = Declared(**swing(sensors={"s": {"delay": 0.1}}))
    with pytest.raises(ModelError, match=r"sim.sensors.s.delay: the base has one already"):
        Extended("more", late, sensors={"s": {"delay": 0.1}}).model()
    node = swing(sensors={"s": {"lag": "a"}})
    node["parameters"]["a"] = {"range": [0.1, 0.5], "per": "rig"}
    with pytest.raises(ModelError, match=r"sim.sensors.s.lag depends on it"):
        grouped(Declared(**node).model(), {"rig": ("one", "two")})
