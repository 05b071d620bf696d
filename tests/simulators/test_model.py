"""Simulators declared in YAML: the equations of SYSTEMS.md, their invariants, and what a user can write wrong."""

import copy
import math
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
import yaml
from systems import SIMS, node

from simulators.model import Declared, Model, ModelError, Quantity


def rates(model: Model, x: list[float], u: float, **values: float) -> np.ndarray:
    """Evaluate dx/dt with the parameters by name, in their units."""
    assert {quantity.name for quantity in model.params} == values.keys()
    p = [values[quantity.name] for quantity in model.params]
    return model.function()(x, u, p)[0].full().ravel()


NOMINAL = {"m": 1.0, "l": 1.0, "C_m": 1.0}
DRAG = {"c_1": 0.5, "c_2": 0.5}


@pytest.mark.parametrize(
    ("sim", "parameters", "x", "u", "expected"),
    [
        ("pendulum", NOMINAL, [0.3, 1.2], 0.5, [1.2, 3.399053227]),
        ("pendulum_published", {"m": 1.0, "l": 1.0, "g": 9.81}, [0.3, 1.2], 0.5, [1.2, 3.399053227]),
        ("pendulum_high_fidelity", NOMINAL | DRAG, [0.3, -3.0], 0.0, [-3.0, 8.899053227]),
        ("pendulum_high_fidelity", NOMINAL | DRAG, [0.3, 3.0], 0.0, [3.0, -3.100946773]),
        ("pendulum_high_fidelity", NOMINAL | DRAG, [0.0, 0.0], 0.0, [0.0, 0.0]),
    ],
)
def test_pendulum_rates(
    sim: str, parameters: dict[str, float], x: list[float], u: float, expected: list[float]
) -> None:
    np.testing.assert_allclose(
        rates(Declared(**node(sim)).model(), x, u, **parameters), expected, rtol=1e-9, atol=1e-12
    )


def test_pendulum_rates_off_nominal() -> None:
    content = node("pendulum_high_fidelity")
    content["parameters"]["g"] = 12
    values = {"m": 0.6, "l": 1.4, "C_m": 1.0, "c_1": 0.45, "c_2": 0.55}
    result = rates(Declared(**content).model(), [3.1, 4.5], -2.5, **values)
    np.testing.assert_allclose(result, [4.5, -31.13194466], rtol=1e-9)


@pytest.mark.parametrize("sim", ["pendulum", "pendulum_high_fidelity", "pendulum_published"])
def test_pendulum_symmetry_and_energy(sim: str) -> None:
    model = Declared(**node(sim)).model()
    random = np.random.default_rng(0)
    for _ in range(20):
        values = {quantity.name: random.uniform(quantity.low, quantity.high) for quantity in model.params}
        phi, omega, u = random.uniform([-3, -5, -2.5], [3, 5, 2.5])
        forward, mirrored = rates(model, [phi, omega], u, **values), rates(model, [-phi, -omega], -u, **values)
        np.testing.assert_allclose(mirrored, -forward, rtol=1e-12)
        m, l, g = values["m"], values["l"], values.get("g", 9.81)  # noqa: E741
        free = rates(model, [phi, omega], 0.0, **values)
        power = (
            m * l**2 * omega * free[1] - m * g * l * math.sin(phi) * omega
        )  # d/dt of m l^2 omega^2/2 + m g l cos phi
        if "c_1" in values:
            assert power < -0.1 * omega**2  # drag takes energy for both signs of omega
        else:
            assert abs(power) < 1e-11


def test_sinusoids() -> None:
    one, two = (Declared(**node(name)).model() for name in ("sinusoid", "sinusoids"))
    values = {"a": 2.1, "w": 1.9, "c": -0.4, "w2": 1.5}
    for model, expected in ((one, [0.7866904662]), (two, [0.7866904662, -0.2573797458])):
        dx, y = model.function()(casadi.DM(0, 1), 1.3, [values[q.name] for q in model.params])
        assert dx.shape == (0, 1)
        np.testing.assert_allclose(y.full().ravel(), expected, rtol=1e-9)
    priors = {q.name: q for q in two.params}
    for name, mean, std in (("a", 2, 0.4), ("c", 2, 1)):
        low, high = priors[name].low, priors[name].high
        assert priors[name].prior == "normal"
        assert ((low + high) / 2, (high - low) / 4) == pytest.approx((mean, std))
    assert priors["w"] == Quantity("w", "1", 1.7, 2.3)
    assert priors["w2"] == Quantity("w2", "1", 1.3, 1.7)


def test_pendulum_quantities() -> None:
    low, high, published = (Declared(**node(f"pendulum{end}")).model() for end in ("", "_high_fidelity", "_published"))
    for model in (low, high, published):
        phi, omega = model.states
        assert phi == Quantity("phi", "rad", -math.pi, math.pi, periodic=True)
        assert omega == Quantity("omega", "rad/s", -5, 5)
        assert model.inputs == (Quantity("u", "V", -2.5, 2.5),)
        assert (model.dt, model.substeps, model.outputs) == (0.05, 5, ())
    mass, length = Quantity("m", "kg", 0.5, 1.5), Quantity("l", "m", 0.5, 1.5)
    motor = Quantity("C_m", "N m/V", 0.8, 1.2)
    assert low.params == (mass, length, motor)
    assert [q.name for q in high.params] == ["m", "l", "C_m", "c_1", "c_2"]
    assert {(q.low, q.high) for q in high.params[3:]} == {(0.4, 0.6)}
    assert published.params == (mass, length, Quantity("g", "m/s^2", 5, 15))
    assert (low.fixed, published.fixed) == ({"g": 9.81}, {"C_m": 1.0})
    assert low.gap == {"phi": 0.02, "omega": 0.35}
    assert high.gap == {"phi": 0.005, "omega": 0.05}
    assert published.gap == {"phi": 0.025, "omega": 0.25}


@pytest.mark.parametrize("path", sorted(SIMS.glob("*.yaml")), ids=lambda path: path.stem)
def test_first_line_says_what_it_is(path: Path) -> None:
    assert path.read_text().startswith("# ")


def tank(**changes: Any) -> dict[str, Any]:
    """Return a small declaration that uses every key, with some replaced."""
    content: dict[str, Any] = {
        "name": "tank",
        "dt": "1e-1",
        "substeps": 2,
        "states": {"h": {"unit": "m", "range": [0, "pi/2"]}, "v": {"range": [-1, 1]}},
        "inputs": {"q": {"unit": "m^3/s", "range": [0, 0.5]}},
        "parameters": {
            "c": "b*k",
            "b": "2*A",
            "A": {"unit": "m^2", "value": "5e-1"},
            "k": {"unit": "1", "range": [0.1, 10], "prior": "lognormal"},
            "rho": "1e3",
        },
        "dynamics": {"v": 0, "h": "(q - c*sqrt(max(h, 0)))/A"},
        "outputs": {"volts": {"unit": "V", "expression": "3*h + q"}, "load": "rho*h*k"},
        "gap": {"h": "1e-3", "volts": 0},
    }
    content = copy.deepcopy(content)
    for path, value in changes.items():
        section, _, key = path.partition("__")
        if key:
            content[section][key] = value
        else:
            content[section] = value
    return content


def test_every_key() -> None:
    model = Declared(**tank()).model()
    assert model.states[0] == Quantity("h", "m", 0, math.pi / 2)
    assert model.states[1].unit == ""
    assert model.params == (Quantity("k", "1", 0.1, 10, prior="lognormal"),)
    assert model.fixed == {"A": 0.5, "b": 1.0, "rho": 1000.0}
    assert model.gap == {"h": 1e-3, "volts": 0.0}
    assert [(q.name, q.unit) for q in model.outputs] == [("volts", "V"), ("load", "")]
    assert all(math.isnan(q.low) and math.isnan(q.high) for q in model.outputs)
    function = model.function()
    assert [function.name_in(i) for i in range(3)] == ["x", "u", "p"]
    assert [function.name_out(i) for i in range(2)] == ["dx", "y"]
    dx, y = function([0.25, 7], 0.2, 3)
    np.testing.assert_allclose(dx.full().ravel(), [(0.2 - 3 * 0.5) / 0.5, 0])  # in the order of the states
    np.testing.assert_allclose(y.full().ravel(), [0.95, 750])


def test_defaults() -> None:
    model = Declared("decay", dt=0.1, states={"c": {"range": [0, 1]}}, dynamics={"c": "-c"}).model()
    assert (model.substeps, model.inputs, model.params, model.outputs, model.gap) == (10, (), (), (), {})
    dx, y = model.function()(0.5, casadi.DM(0, 1), casadi.DM(0, 1))
    assert (float(dx), y.shape) == (-0.5, (0, 1))


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"name": "two words"}, r"sim.name: 'two words' is no model name; allowed: letters"),
    ({"name": 3}, r"sim.name: 3 is no model name"),
    ({"dt": 0}, r"sim.dt: 0 s is not positive; give the duration"),
    ({"dt": -0.1}, r"sim.dt: -0.1 s is not positive"),
    ({"dt": math.inf}, r"sim.dt: inf is not finite"),
    ({"dt": None}, r"sim.dt: None is not a number"),
    ({"dt": "fast"}, r"(?s)sim.dt: unknown name 'fast'"),
    ({"substeps": 0}, r"sim.substeps: 0 is not allowed; give a whole number, at least 1"),
    ({"substeps": 2.5}, r"sim.substeps: 2.5 is not allowed"),
    ({"substeps": True}, r"sim.substeps: True is not allowed"),
    ({"states": ["h"]}, r"sim.states: \['h'\] is not a mapping; write `states: \{name: ...\}`"),
    ({"states__h": 3}, r"sim.states.h: 3 is not a mapping"),
    ({"states": {}, "outputs": {}, "dynamics": {}, "gap": {}}, "sim.states: neither states nor outputs"),
    ({"states__h": {"unit": "m"}}, r"sim.states.h: no range; add `range: \[low, high\]`"),
    ({"states__h": {"range": [1, 0]}}, r"sim.states.h.range: low = 1 is not below high = 0; swap them"),
    ({"states__h": {"range": [1, 1]}}, r"sim.states.h.range: low = 1 is not below high = 1; give low < high"),
    ({"states__h": {"range": [0, math.nan]}}, r"sim.states.h.range: nan is not finite"),
    ({"states__h": {"range": [0, 1, 2]}}, r"sim.states.h.range: \[0, 1, 2\] is not a range; write \[low, high\]"),
    ({"states__h": {"range": 5}}, r"sim.states.h.range: 5 is not a range"),
    ({"states__h": {"range": [0, True]}}, r"sim.states.h.range: True is not a number"),
    ({"states__h": {"range": [0, 1], "unit": 1}}, r'sim.states.h.unit: 1 is not a text; quote it, e.g. unit: "1"'),
    (
        {"states__h": {"rnage": [0, 1]}},
        r"sim.states.h.rnage: unknown key; allowed: unit, range, periodic.*mean range\?",
    ),
    ({"states__h": {"range": [0, 1], "periodic": "yes please"}}, r"sim.states.h.periodic: .* write true or false"),
    ({"inputs__q": {"range": [0, 1], "prior": "normal"}}, r"sim.inputs.q.prior: unknown key"),
    ({"states": {False: {"range": [0, 1]}}}, r'sim.states: a name became False: YAML reads no, off.*quote it \("no"'),
    ({"inputs": {True: {"range": [0, 1]}}}, r"sim.inputs: a name became True: YAML"),
    ({"parameters": {3: 1.0}}, r"sim.parameters: 3 is no name; allowed: letters, digits"),
    ({"inputs__my input": {"range": [0, 1]}}, r"sim.inputs: 'my input' is no name"),
    ({"inputs____class__": {"range": [0, 1]}}, r"sim.inputs: '__class__' is no name"),
    ({"inputs__lambda": {"range": [0, 1]}}, r"sim.inputs: 'lambda' is no name; .* no word of Python's"),
    ({"inputs__sin": {"range": [0, 1]}}, r"sim.inputs.sin: sin is a function of expressions; choose another name"),
    ({"parameters__pi": 3}, r"sim.parameters.pi: pi is a constant of expressions"),
    ({"inputs__h": {"range": [0, 1]}}, r"sim.inputs.h: the name is taken by sim.states.h; choose another name"),
    ({"outputs__k": "h"}, r"sim.outputs.k: the name is taken by sim.parameters.k"),
    ({"dynamics": {"h": "-h"}}, r"sim.dynamics: no entry for the state v; add `v: <its time derivative>`"),
    ({"dynamics__vv": "h"}, r"sim.dynamics.vv: is no state; known: h, v. Did you mean v\?"),
    ({"dynamics__h": "q - c*hh"}, r"(?s)sim.dynamics.h: unknown name 'hh'; known here: .*\n  q - c\*hh\n        \^"),
    ({"dynamics__h": "volts"}, r"sim.dynamics.h: unknown name 'volts'"),
    ({"dynamics__h": None}, r"sim.dynamics.h: None is no expression; write a formula"),
    ({"dynamics__h": True}, r"sim.dynamics.h: True is no expression"),
    ({"dynamics__h": math.nan}, r"sim.dynamics.h: unknown name 'nan'"),
    ({"dynamics__h": "h > 0 and q > 0"}, r"sim.dynamics.h: `and` and `or` are not allowed"),
    ({"outputs__volts": {"unit": "V"}}, r"sim.outputs.volts: no expression; add `expression: <formula>`"),
    ({"outputs__volts": {"unit": "V", "expr": "h"}}, r"sim.outputs.volts.expr: unknown key; allowed: unit, expression"),
    ({"outputs__volts": {"unit": 5, "expression": "h"}}, r"sim.outputs.volts.unit: 5 is not a text"),
    ({"outputs__volts": "hh"}, r"sim.outputs.volts: unknown name 'hh'"),
    ({"outputs__volts": {"expression": ["h"]}}, r"sim.outputs.volts: \['h'\] is no expression"),
    ({"parameters__k": None}, r"sim.parameters.k: None is not a number"),
    ({"parameters__k": True}, r"sim.parameters.k: True is not a number"),
    ({"parameters__k": math.inf}, r"sim.parameters.k: inf is not finite"),
    ({"parameters__k": [0, 1]}, r"sim.parameters.k: \[0, 1\] is not a number"),
    ({"parameters__k": {"unit": "1"}}, r"sim.parameters.k: no range; add `range"),
    ({"parameters__k": {"value": 1, "range": [0, 1]}}, r"sim.parameters.k.range: unknown key.* takes no range"),
    ({"parameters__k": {"value": 1, "unit": 2}}, r"sim.parameters.k.unit: 2 is not a text"),
    ({"parameters__k": {"value": "h"}}, r"sim.parameters.k.value: unknown name 'h'"),
    ({"parameters__k": {"range": [0, 1], "periodic": True}}, r"sim.parameters.k.periodic: unknown key; .*prior"),
    (
        {"parameters__k": {"range": [0, 1], "prior": "norml"}},
        r"sim.parameters.k.prior: 'norml' is no prior.*mean normal\?",
    ),
    (
        {"parameters__k": {"range": [0, 1], "prior": "lognormal"}},
        r"k.range: low = 0 has no logarithm; .* needs 0 < low",
    ),
    ({"parameters__b": "2*kk"}, r"sim.parameters.b: uses kk, which is no parameter; known: .* Did you mean k\?"),
    ({"parameters__b": "2*h"}, r"sim.parameters.b: uses h, which is no parameter"),
    ({"parameters__b": "2*"}, r"sim.parameters.b: this is not a formula"),
    ({"parameters__b": "2*k + sin()"}, r"sim.parameters.b: sin takes 1 argument.s., 0 given"),
    ({"parameters__b": "9**9**9"}, r"sim.parameters.b: this part is not a finite number"),
    ({"parameters__b": "c + 1"}, r"sim.parameters: derived in a circle, (b -> c -> b|c -> b -> c); give one of them"),
    ({"parameters__b": "b"}, r"sim.parameters: derived in a circle, b -> b"),
    ({"gap__hh": 0.1}, r"sim.gap.hh: is neither a state nor an output; known: h, v, volts, load. Did you mean h\?"),
    ({"gap__q": 0.1}, r"sim.gap.q: is neither a state nor an output"),
    ({"gap__h": -1}, r"sim.gap.h: -1 is negative; give a standard deviation, 0 for none"),
    ({"gap__h": math.nan}, r"sim.gap.h: nan is not finite"),
    ({"gap": None}, r"sim.gap: None is not a mapping"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_wrong_declarations(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Declared(**tank(**changes)).model()


def test_yaml_booleans_reach_the_message() -> None:
    content = yaml.safe_load("{name: m, dt: 1, states: {no: {range: [0, 1]}}, dynamics: {no: 0}}")
    with pytest.raises(ModelError, match="YAML reads no, off, false, yes, on and true as booleans"):
        Declared(**content).model()


def test_a_python_model_with_wrong_rows_is_refused() -> None:
    states = (Quantity("a", "m", 0, 1), Quantity("b", "m", 0, 1))
    model = Model(
        "short", 0.1, 1, states, (), (), (), lambda x, u, p: x[0], lambda x, u, p: casadi.MX(0, 1), symbol=casadi.MX
    )
    with pytest.raises(
        ModelError, match=r"short: dx has shape \(1, 1\), expected \(2, 1\): one row for each of \['a', 'b'\]"
    ):
        model.function()


LATE = {
    "name": "late", "dt": 0.1,
    "states": {"v": {"unit": "m/s", "range": [-2, 2]}},
    "parameters": {"d": {"unit": "s", "range": [0.05, 0.15]}, "T": 0.2},
    "dynamics": {"v": "u - v"},
}  # fmt: skip


class TestLateInputs:
    def test_a_delay_is_a_number_or_a_parameter(self) -> None:
        inputs = {"u": {"unit": "V", "range": [-1, 1], "delay": "d", "lag": "T"}}
        model = Declared(**LATE, inputs=inputs).model()
        assert (model.delay, model.lag) == ({"u": "d"}, {"u": "T"})
        assert model.memory() == pytest.approx(0.15 + 3 * 0.2)

    @pytest.mark.parametrize(
        ("own", "message"),
        [
            ({"delay": -0.1}, "sim.inputs.u.delay: -0.1 s is negative"),
            ({"lag": "tau"}, "sim.inputs.u.lag: 'tau' is neither a number (s) nor a parameter"),
            ({"dealy": 0.1}, "dealy"),
        ],
    )
    def test_wrong_ones_are_refused(self, own: dict, message: str) -> None:
        with pytest.raises(ModelError) as caught:
            Declared(**LATE, inputs={"u": {"unit": "V", "range": [-1, 1], **own}}).model()
        assert message in str(caught.value)
