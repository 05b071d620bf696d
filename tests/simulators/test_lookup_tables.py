"""Tables of a declared simulator against CasADi's own interpolation, from files and from YAML, and what can be wrong."""

import json
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
import yaml
from command_line import TINY, rig, simpel

from simpel_cli.dynamics.casadi_jax import checked
from simulators.built import Built
from simulators.model import Declared, ModelError
from simulators.racecar import RaceCar
from simulators.table_files import files_of, with_files_read
from simulators.tables import table

CASADI = {"linear": "linear", "cubic": "bspline"}
AXIS, OTHER = [-2.0, -1.5, 0.25, 1.0, 4.0, 4.5], [10.0, 20.0, 35.0, 36.0, 60.0]


@pytest.mark.parametrize("method", CASADI)
@pytest.mark.parametrize("nodes", [AXIS, AXIS[:4], list(np.linspace(0, 3, 25))], ids=["6", "4", "25"])
def test_one_input_is_what_casadi_interpolates(nodes: list[float], method: str) -> None:
    random = np.random.default_rng(0)
    values = random.normal(scale=30, size=len(nodes))
    x = casadi.SX.sym("x")
    own = casadi.Function("own", [x], [table([nodes], values, method, [x])])
    other = casadi.interpolant("other", CASADI[method], [nodes], values)
    at = np.concatenate([random.uniform(nodes[0], nodes[-1], 200), nodes])[None]
    np.testing.assert_allclose(own(at).full(), other(at).full(), rtol=0, atol=1e-9)
    assert [float(own(nodes[0] - 9)), float(own(nodes[-1] + 9))] == pytest.approx([values[0], values[-1]], abs=1e-9)


@pytest.mark.parametrize("method", CASADI)
def test_two_inputs_are_what_casadi_interpolates(method: str) -> None:
    random = np.random.default_rng(0)
    values = random.normal(scale=30, size=(len(AXIS), len(OTHER)))
    x, y = casadi.SX.sym("x"), casadi.SX.sym("y")
    own = casadi.Function("own", [x, y], [table([AXIS, OTHER], values, method, [x, y])])
    other = casadi.interpolant("other", CASADI[method], [AXIS, OTHER], values.ravel(order="F"))
    at = np.array([random.uniform(axis[0], axis[-1], 200) for axis in (AXIS, OTHER)])
    np.testing.assert_allclose(own(*at[:, None]).full(), other(at).full(), rtol=0, atol=1e-9)
    assert float(own(-9, 15)) == pytest.approx(float(own(-2, 15)), abs=1e-9)
    assert float(own(9, 99)) == pytest.approx(values[-1, -1], abs=1e-9)
    slope = casadi.Function("slope", [x, y], [casadi.gradient(own(x, y), casadi.vertcat(x, y))])
    reference = casadi.MX.sym("z", 2)
    gradient = casadi.Function("gradient", [reference], [casadi.gradient(other(reference), reference)])
    for point in at.T[:20]:
        np.testing.assert_allclose(slope(*point).full(), gradient(point).full(), rtol=0, atol=1e-8)
    np.testing.assert_allclose(slope(9, 99).full(), 0)


def engine(**tables: Any) -> dict[str, Any]:
    return {
        "name": "engine",
        "dt": 0.1,
        "states": {"w": {"unit": "rad/s", "range": [0, 600]}},
        "inputs": {"throttle": {"unit": "1", "range": [0, 1]}},
        "parameters": {"J": {"unit": "kg m^2", "range": [0.1, 0.3]}, "gain": {"range": [0.5, 2]}},
        "intermediates": {"rpm": {"unit": "1/min", "expression": "w*30/pi"}, "push": "gain*torque"},
        "tables": {
            "torque": {
                "unit": "N m",
                "inputs": ["rpm", "throttle"],
                "axes": [[0, 2000, 6000], [0, 1]],
                "values": [[-5, 60], [-15, 110], [-30, 80]],
            },
            "drag": {"inputs": ["w"], "axes": [[0, 200, 400, 600]], "values": [0, 1, 5, 15], "method": "cubic"},
            **tables,
        },
        "dynamics": {"w": "(push - drag)/J"},
        "outputs": {"T": {"unit": "N m", "expression": "torque"}},
    }


def test_a_table_is_a_name_like_an_intermediate() -> None:
    model = Declared(**engine()).model()
    function = model.function()
    w, throttle = 3000 * np.pi / 30, 0.5
    torque = (-15 + 110) / 2 * 0.75 + (-30 + 80) / 2 * 0.25
    drag = casadi.interpolant("drag", "bspline", [[0, 200, 400, 600]], [0, 1, 5, 15])(w)
    rates, outputs = function(w, throttle, [0.2, 1.5])
    assert float(outputs) == pytest.approx(torque)
    assert float(rates) == pytest.approx((1.5 * torque - float(drag)) / 0.2)
    checked(
        function, [[(-100.0, 800.0)], [(-1.0, 2.0)], [(0.1, 0.3), (0.5, 2.0)]]
    )  # the same in JAX, outside the axes, too


def test_a_table_of_a_table_and_of_parameters() -> None:
    more = {"twice": {"inputs": ["drag"], "axes": [[0, 100]], "values": [0, 200]}, "of_gain": {
        "inputs": ["gain"], "axes": [[0, 1, 2]], "values": [3, 4, 7]}}  # fmt: skip
    content = engine(**more) | {"outputs": {"a": "twice - 2*drag", "b": "of_gain"}}
    outputs = Declared(**content).model().function()(300, 0, [0.2, 1.5])[1]
    np.testing.assert_allclose(outputs.full().ravel(), [0, 5.5], atol=1e-12)


def test_a_simulator_in_python_has_outputs_of_tables() -> None:
    assert issubclass(RaceCar, Built)
    path = Path(__file__).parents[2] / "conf" / "sim" / "racecar.yaml"
    node = yaml.safe_load(path.read_text())
    del node["_target_"]
    node["parameters"] |= {"k": {"range": [1, 2]}}
    # an intermediate that has no value where the coordinates of the car are entered, with inputs of 0
    node["intermediates"] = {"ratio": "vx/throttle"}
    node["tables"] = {"volts": {"inputs": ["vx"], "axes": [[-6, 6]], "values": [-12, 12]}}
    node["outputs"] = {"tacho": "k*volts", "r": "ratio"}
    model = RaceCar(**node).model()
    model.flow()
    p = [q.middle for q in model.params]
    p[[q.name for q in model.params].index("k")] = 1.5
    np.testing.assert_allclose(model.function()([0, 0, 0, 2, 0, 0], [0, 0.5], p)[1].full().ravel(), [6, 4])


WRONG = [
    ({"axes": [[0, 2, 1]]}, "sim.tables.t.axes: w is not increasing: 2 then 1 (nodes 2 and 3); sort the nodes, each once"),
    ({"axes": [[0, 1, 1]]}, "w is not increasing: 1 then 1"),
    ({"axes": [[0]], "values": [1]}, "sim.tables.t.axes: 1 node(s) of w; linear needs at least 2; add nodes"),
    ({"method": "cubic"}, "sim.tables.t.axes: 3 node(s) of w; cubic needs at least 4; add nodes, or write method: linear"),
    ({"method": "spline"}, "sim.tables.t.method: 'spline' is not allowed, only linear or cubic"),
    ({"values": [1, 2]}, "sim.tables.t.values: 2 entries; the axes ask for 3 numbers; give one value for each node"),
    ({"values": [1, 2, float("nan")]}, "sim.tables.t.values: nan is not finite; give a finite number"),
    ({"values": [1, 2, "x"]}, "sim.tables.t.values: unknown name 'x'"),
    ({"axes": [0, 1, 2]}, "sim.tables.t.axes: [0, 1, 2] is not allowed; write a list of nodes for each of w"),
    ({"inputs": ["w", "throttle"]}, "sim.tables.t.axes: [[0, 1, 2]] is not allowed; write a list of nodes for each of w, thro"),
    ({"inputs": ["w", "throttle"], "axes": [[0, 1, 2], [0, 1]], "values": [[1, 2], [1, 2], [1]]}, "values: 1 entries"),
    ({"inputs": ["ww"]}, "sim.tables.t.inputs: 'ww' is no state, input, parameter, intermediate or table; known: w, "),
    ({"inputs": ["T"]}, "sim.tables.t.inputs: 'T' is no state, input"),
    ({"inputs": "w"}, "sim.tables.t.inputs: 'w' is not allowed; write one or two names"),
    ({"inputs": ["w", "w"]}, "sim.tables.t.inputs: ['w', 'w'] is not allowed"),
    ({"inputs": ["t"]}, "sim.tables: derived in a circle, t -> t; write one of them without the others"),
    ({"unit": 3}, "sim.tables.t.unit: 3 is not a text"),
    ({"file": "map.csv"}, "sim.tables.t.axes: given beside file; leave out file, or axes and values"),
    ({"kind": "linear"}, "sim.tables.t.kind: unknown key; allowed: unit, inputs, method, file, axes, values"),
]  # fmt: skip


@pytest.mark.parametrize(("own", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_wrong_tables_are_refused(own: dict[str, Any], message: str) -> None:
    node = {"inputs": ["w"], "axes": [[0, 1, 2]], "values": [0, 1, 4]} | own
    with pytest.raises(ModelError) as caught:
        Declared(**engine(t=node)).model()
    assert message in str(caught.value)


def test_a_table_needs_numbers() -> None:
    for node, message in (
        ({"inputs": ["w"]}, "no axes; give `file: <CSV>`, or"),
        ({"inputs": ["w"], "axes": [[0, 1]]}, "no val"),
    ):
        with pytest.raises(ModelError) as caught:
            Declared(**engine(t=node)).model()
        assert message in str(caught.value)


GRID = "rpm, throttle, torque\n2000, 1, 4\n0, 0, 1\n\n0, 1, 2\n2000, 0, 3\n"
FILES = [
    ("w,y\n0,1\n1\n", ["w"], "t.csv, line 3: 1 columns; a table has 2 columns, w and the value, separated by commas"),
    ("w;y\n0;1\n", ["w"], "line 1: 1 columns"),
    ("0,1\n1,2\n", ["w"], "t.csv begins with no header line; name the 2 columns, w and the value"),
    ("", ["w"], "begins with no header line"),
    ("w,y\n0,1\n1,nan\n", ["w"], "t.csv, line 3: 'nan' is not a finite number; fill it in, or leave out its row"),
    ("w,y\n0,1\n1,\n", ["w"], "line 3: '' is not a finite number"),
    ("w,y\n0,1\n0,2\n", ["w"], "t.csv, line 3: w = 0 stands there twice; keep one row"),
    ("w,y\n1,1\n0,2\n", ["w"], "sim.tables.t.axes: w is not increasing: 1 then 0 (nodes 1 and 2)"),
    ("w,y\n", ["w"], "sim.tables.t.axes: 0 node(s) of w; linear needs at least 2"),
    (GRID.replace("\n0, 1, 2", ""), ["rpm", "throttle"], "t.csv is no full grid: 2 x 2 nodes, 1 without a value, first rpm = "),
    (GRID, ["throttle", "rpm"], "t.csv has the columns rpm, throttle, inputs are [throttle, rpm]; write them in one order"),
    (None, ["w"], "sim.tables.t.file: t.csv is missing; looked for "),
    (b"\xff\xfe\x00", ["w"], "t.csv is not readable ("),
]  # fmt: skip


@pytest.mark.parametrize(("text", "inputs", "message"), FILES, ids=[message[:60] for *_, message in FILES])
def test_wrong_files_are_refused(text: str | bytes | None, inputs: list[str], message: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "t.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ModelError) as caught:
        Declared(**with_files_read(engine(t={"inputs": inputs, "file": "t.csv"}), [tmp_path])).model()
    assert message in str(caught.value)
    assert str(caught.value).startswith("sim.tables.t.")


def test_a_file_becomes_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "map.csv").write_text(GRID, encoding="utf-8-sig")
    given = engine(torque={"unit": "N m", "inputs": ["rpm", "throttle"], "file": "map.csv"})
    node = with_files_read({"base": given}, [tmp_path / "nothing", tmp_path])["base"]
    torque = node["tables"]["torque"]
    assert (torque["axes"], torque["values"]) == ([[0, 2000], [0, 1]], [[1, 2], [3, 4]])
    assert list(files_of({"base": node})) == [str(tmp_path / "map.csv")]
    assert "file" in given["tables"]["torque"]  # what was given is not changed
    monkeypatch.chdir(tmp_path)  # in Python the working directory is tried
    for content in (node, given):
        assert float(Declared(**content).model().function()(0, 0.5, [0.2, 1])[1]) == pytest.approx(1.5)


CART = """\
name: cart
dt: 0.05
states: {s: {unit: m, range: [-0.5, 0.5]}, v: {unit: m/s, range: [-2, 2]}}
inputs: {u: {unit: V, range: [-3, 3]}}
parameters: {m: {unit: kg, range: [0.5, 2.0]}, c: 2.0}
tables: {spring: {unit: N, inputs: [s], file: spring.csv}}
dynamics: {s: v, v: (c*u - spring)/m}
"""


def test_a_run_needs_the_file_no_more(tmp_path: Path) -> None:
    """It lies beside the YAML; what is wrong with it is said before a run is begun; the manifest has its digest."""
    my = rig(tmp_path, cart=CART)
    words = ("fit", "--config-dir", my, "sim=cart", "data=rig", "hydra.run.dir=run", *TINY)
    missing = simpel(tmp_path, *words)
    assert missing.code == 2
    assert "sim.tables.spring.file: spring.csv is missing; looked for" in missing.err
    assert not (tmp_path / "run" / "manifest.json").exists()
    file = next(my.rglob("cart.yaml")).parent / "spring.csv"
    file.write_text("s,F\n-0.5,-12\n0,0\n0.5,12\n")
    fitted = simpel(tmp_path, *words)
    assert fitted.code == 0, fitted.err
    assert str(file) in json.loads((tmp_path / "run" / "manifest.json").read_text())["inputs_sha256"]
    kept = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["sim"]["tables"]["spring"]
    assert (kept["axes"], kept["values"], "file" in kept) == ([[-0.5, 0, 0.5]], [-12, 0, 12], False)
    assert "dv/dt = (c*u - spring)/m" in simpel(tmp_path, "sims", "cart", "--config-dir", my).out
    file.unlink()
    evaluated = simpel(tmp_path, "evaluate", "run", "run.quiet=true")
    assert evaluated.code == 0, evaluated.err
