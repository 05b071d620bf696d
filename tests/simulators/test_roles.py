"""Roles of states: declared, or read off units and equations; where effects attach then."""

import pytest
import yaml

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simulators.effects import Scales, structure
from simulators.model import Declared, Model, ModelError


def shaft(unit: str = "rad/s", role: str | None = None) -> Model:
    """Return a shaft with a motor and a heated winding."""
    turning: dict = {"unit": unit, "range": [-10, 10]} | ({"role": role} if role else {})
    return Declared(
        name="shaft",
        dt=0.1,
        states={"angle": {"unit": "rad", "range": [-9, 9]}, "n": turning, "T": {"unit": "K", "range": [0, 90]}},
        inputs={"u": {"unit": "V", "range": [-1, 1]}},
        parameters={"gear": {"unit": "1", "range": [0.1, 0.2]}},
        dynamics={"angle": "gear*n", "n": "u - 0.1*n", "T": "u**2 - T"},
    ).model()


def places(model: Model, effect: str) -> list[str]:
    node = yaml.safe_load((conf_dir() / "effect" / f"{effect}.yaml").read_text())
    scales = Scales({q.name: 1.0 for q in (*model.states, *model.inputs)}, {q.name: 2.0 for q in model.states}, 0.1)
    return [term.acts_on for term in build(node, "effect").attach(model, scales, ("angle",))]


@pytest.mark.parametrize("unit", ["m/s", "rad/s", "deg/s", "1/min", "rpm"])
def test_a_unit_says_that_a_state_is_a_velocity(unit: str) -> None:
    model = shaft(unit)
    assert structure(model).velocity == {"n": None}
    assert structure(model).inferred["n"] == f"unit {unit}"
    assert places(model, "coulomb_friction") == ["n"]


def test_a_declared_velocity_is_one_whatever_its_unit() -> None:
    assert places(shaft("1/s"), "coulomb_friction") == []
    model = shaft("1/s", "velocity")
    assert places(model, "coulomb_friction") == ["n"]
    assert structure(model).inferred == {}


def test_a_declared_role_goes_before_what_unit_and_equations_say() -> None:
    assert structure(shaft("rad/s", "other")).velocity == {}
    assert "n" in structure(shaft("rad/s", "other")).first_order
    # the rate of the angle has an uncertain gear: nothing but its role says that no force acts there
    assert structure(shaft()).first_order == ("angle", "T")
    model = shaft(role="velocity")
    states = tuple(q._replace(role="position") if q.name == "angle" else q for q in model.states)
    declared = structure(Model(**{**vars(model), "states": states}))
    assert (declared.kinematic, declared.first_order, declared.velocity) == (("angle",), ("T",), {"n": None})
    node = yaml.safe_load((conf_dir() / "sim" / "pendulum.yaml").read_text())
    assert structure(build(node, "sim").model()).inferred == {"phi": "its rate is omega", "omega": "unit rad/s"}
    node["states"]["phi"]["role"] = "other"
    assert structure(build(node, "sim").model())[:3] == ((), {"omega": None}, ("phi",))


def test_a_wrong_role_is_refused() -> None:
    states = {"T": {"range": [0, 1], "role": "temprature"}}
    with pytest.raises(ModelError, match=r"sim.states.T.role: 'temprature' is not allowed, only .* mean temperature\?"):
        Declared(name="s", dt=1, states=states, dynamics={"T": "0"}).model()
    with pytest.raises(ModelError, match=r"sim.inputs.u.role: unknown key"):
        Declared(name="s", dt=1, inputs={"u": {"range": [0, 1], "role": "level"}}, outputs={"y": "u"}).model()
