"""JSON Schemas of YAML files: all of simpel's own fit, mistakes do not, and no key that is read is left out."""

import copy
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import ROOT, simpel
from jsonschema import Draft202012Validator

from simpel_cli.config.group_classes import CLASSES
from simpel_cli.config.schemas import NAMES, classes_of, schema
from simulators.model import Declared, ModelError
from simulators.worlds.mujoco_world import MujocoWorld

VALIDATORS = {name: Draft202012Validator(schema(name)) for name in NAMES}
FILES = [(name, path) for name in NAMES for path in sorted((ROOT / "conf" / name).glob("*.yaml"))]


@pytest.mark.parametrize("name", NAMES)
def test_it_is_a_schema(name: str) -> None:
    Draft202012Validator.check_schema(VALIDATORS[name].schema)


@pytest.mark.parametrize(("name", "path"), FILES, ids=[f"{name}/{path.stem}" for name, path in FILES])
def test_every_yaml_of_simpel_fits(name: str, path: Path) -> None:
    VALIDATORS[name].validate(yaml.safe_load(path.read_text()))


def test_the_yaml_of_the_example_fits(tmp_path: Path) -> None:
    assert simpel(tmp_path, "example", "my").code == 0
    found = [(name, path) for name in NAMES for path in (tmp_path / "my").rglob(f"{name}/*.yaml")]
    assert {name for name, _ in found} == set(NAMES)
    for name, path in found:
        VALIDATORS[name].validate(yaml.safe_load(path.read_text()))


SIM: dict[str, Any] = {
    "name": "engine",
    "dt": "1/10",
    "states": {"w": {"unit": "rad/s", "range": [0, "200*pi"], "limits": [0, None], "role": "velocity"}},
    "inputs": {"u": {"range": [0, 1], "delay": "tau", "lag": 0.1}},
    "parameters": {"tau": {"unit": "s", "value": 0.1}, "J": {"range": [1, 2], "prior": "lognormal"}, "k": "2*J", "g": 9.81},
    "intermediates": {"rpm": {"unit": "1/min", "expression": "w*30/pi"}, "load": "k*w"},
    "tables": {
        "torque": {"unit": "N m", "inputs": ["rpm", "u"], "method": "linear", "axes": [[0, 1], [0, 1]],
                   "values": [[0, 1], [2, 3]]},
        "drag": {"inputs": ["w"], "file": "drag.csv", "method": "cubic"},
    },
    "dynamics": {"w": "torque - load - drag"},
    "outputs": {"a": "w", "V": {"expression": "w", "scale": "k", "bias": 1, "saturates": [None, 5], "lag": 0.1,
                                 "range": [0, 9]}},
    "gap": {"w": 0.1},
}  # fmt: skip
OF_A_SIM = [
    {"dynamic": {}},
    {"dt": None},
    {"dt": ...},
    {"name": ...},
    {"substeps": 2.5},
    {"states.w.range": [0, 1, 2]},
    {"states.w.range": ...},
    {"states.w.limits": [0]},
    {"states.w.role": "speed"},
    {"states.w.periodic": "yes"},
    {"states.w.delay": 1},
    {"inputs.u.unit": 3},
    {"inputs.u.role": "velocity"},
    {"parameters.J.prior": "gaussian"},
    {"parameters.J.range": ...},
    {"parameters.J.lag": 1},
    {"parameters.g": [1, 2]},
    {"intermediates.rpm.expression": ...},
    {"intermediates.rpm.range": [0, 1]},
    {"tables.torque.method": "spline"},
    {"tables.torque.inputs": ["a", "b", "c"]},
    {"tables.torque.inputs": ...},
    {"tables.torque.axes": [[0], [0, 1]]},
    {"tables.drag.csv": "x"},
    {"outputs.V.saturates": 5},
    {"outputs.V.gain": 5},
    {"dynamics.w": {"expression": "0"}},
    {"_target_": "simulators.racecar.RaceCar"},
    {"_target_": "simulators.worlds.callable_world.CallableWorld", "function": "a.b"},
]
OF_OTHERS = [
    ("data", {"path": "a.csv", "colums": {}}),
    ("data", {"time": "t"}),
    ("data", {"path": "a.csv", "split": {"test_fraction": 1.5}}),
    ("data", {"path": "a.csv", "split": {"fraction": 0.5}}),
    ("data", {"path": "a.csv", "columns": {"x": 3}}),
    ("data", {"path": "a.csv", "layout": "rows"}),
    ("data", {"path": "a.csv", "n_train": "many"}),
    ("data", {"path": "a.csv", "noise_std": {"x": "small"}}),
    ("data", {"path": "a.csv", "noise": {"scale": "abs(y)"}}),
    ("data", {"path": "a.csv", "noise": {"scale": {"y": ["1"]}}}),
    ("reward", {"reward": "-x**2", "horizont": 3}),
    ("reward", {"horizon": 3}),
    ("reward", {"reward": "1", "initial": {"x": [0, 1, 2]}}),
    ("reward", {"reward": "1", "initial": {"x": {"mean": 0}}}),
    ("reward", {"reward": "1", "limits": {"u": 3}}),
    ("experiment", {"sims": {}}),
    ("experiment", {"data": {"n_trian": 3}}),
    ("experiment", {"data": None}),
    ("experiment", {"run": {"seeds": "many"}}),
    ("experiment", {"run": {"speed": 3}}),
    ("experiment", {"sim": {"parameters": {"m": {"prior": "gaussian"}}}}),
    ("experiment", {"truth": {"parameters": {"m": {"range": [0, 1, 2]}}}}),
    ("experiment", {"method": {"steeps": 3}}),
    ("experiment", {"defaults": "pendulum"}),
]


def changed(change: dict[str, Any]) -> dict[str, Any]:
    content = copy.deepcopy(SIM)
    for path, value in change.items():
        *above, key = path.split(".")
        node = content
        for part in above:
            node = node[part]
        if value is ...:
            del node[key]
        else:
            node[key] = value
    return content


def test_a_simulator_with_every_key_fits() -> None:
    VALIDATORS["sim"].validate(SIM)
    VALIDATORS["experiment"].validate({"sim": SIM, "truth": {"parameters": {"m": 3}}, "reward": None})


@pytest.mark.parametrize("change", OF_A_SIM, ids=str)
def test_mistakes_in_a_simulator_are_refused(change: dict[str, Any]) -> None:
    assert not VALIDATORS["sim"].is_valid(changed(change))


@pytest.mark.parametrize(("name", "content"), OF_OTHERS, ids=str)
def test_mistakes_are_refused(name: str, content: dict[str, Any]) -> None:
    assert not VALIDATORS[name].is_valid(content)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("sim", {"defaults": ["pendulum", "_self_"], "parameters": {"m": {"range": [0, 1]}}}),
        ("sim", {"_target_": "my.package.Sim", "anything": 1}),  # of a package of the user's own
        ("data", {"path": "${simpel_shared:}/a.parquet", "n_train": "${oc.env:N}", "resample": "???", "seed": None}),
        ("data", {"path": ["a.csv", "b.csv"], "columns": {"x": None}, "noise_std": {"x": 1}, "split": {"column": "s"}}),
        ("data", {"path": "a.csv", "noise": {"law": "gaussian", "scale": {"y": "0.01 + 0.05*abs(y)", "T": 1}}}),
        ("experiment", {"defaults": ["a", {"override /sim": "b"}, {"/sim@truth": "c"}, "_self_"], "close": True}),
        ("experiment", {"effect": {"x": {"parameters": {"a": {"range": [0, 1]}}}}, "hydra": {"run": {"dir": "x"}}}),
    ],
)
def test_what_is_allowed_fits(name: str, content: dict[str, Any]) -> None:
    VALIDATORS[name].validate(content)


def test_every_field_of_every_class_is_in_a_schema() -> None:
    definitions = VALIDATORS["experiment"].schema["$defs"]
    for name in ("sim", "data", "reward"):
        definitions = definitions | VALIDATORS[name].schema["$defs"]
    seen = 0
    for group in CLASSES:
        for target, cls in classes_of(group).items():
            names = {field.name.removesuffix("_") for field in dataclasses.fields(cls)}
            for key in (target, f"{target}.partial") if group in ("sim", "data", "reward") else (f"{target}.partial",):
                assert set(definitions[key]["properties"]) == names | {"_target_", "defaults"}
                seen += 1
            assert set(getattr(cls, "sections", {})) <= names
            undescribed = [n for n in names if not definitions[f"{target}.partial"]["properties"][n].get("description")]
            assert undescribed == [], f"{target}: fields without a line in the docstring"
    assert seen > 30


@pytest.mark.parametrize(
    ("section", "node"),
    [
        ("states", {"range": [0, 1]}),
        ("inputs", {"range": [0, 1]}),
        ("intermediates", {"expression": "1"}),
        ("tables", {"inputs": ["w"]}),
        ("outputs", {"expression": "1"}),
    ],
)
def test_the_keys_of_a_section_are_those_that_are_read(section: str, node: dict[str, Any]) -> None:
    given: dict[str, Any] = {section: {"q": {**node, "nonsense": 1}}}
    if section == "states":
        given["states"]["w"] = {"range": [0, 1]}
    else:
        given["dynamics"] = {"w": 0}
    with pytest.raises(ModelError) as caught:
        Declared(
            **{"name": "x", "dt": 1, "states": {"w": {"range": [0, 1]}}, "dynamics": {"w": 0, "q": 0}} | given
        ).model()
    allowed = re.search(r"unknown key; allowed: ([\w, ]+);", str(caught.value))
    assert allowed
    entry = Declared.sections[section]["additionalProperties"]
    keys = next(option for option in entry.get("anyOf", [entry]) if "properties" in option)
    assert set(keys["properties"]) == set(allowed[1].split(", "))


def test_the_keys_of_a_world_are_those_that_are_read() -> None:
    keys = set(MujocoWorld.sections["parameters"]["additionalProperties"]["properties"])
    assert keys == {"unit", "range", "prior", "value", "element", "field", "index"}


def test_the_command(tmp_path: Path) -> None:
    for name in NAMES:
        assert json.loads(simpel(tmp_path, "schema", name).out) == VALIDATORS[name].schema
    written = simpel(tmp_path, "schema", "--write", "a/b")
    assert written.code == 0
    assert {path.name for path in (tmp_path / "a" / "b").iterdir()} == {f"{name}.schema.json" for name in NAMES}
    assert json.loads((tmp_path / "a" / "b" / "sim.schema.json").read_text()) == VALIDATORS["sim"].schema
    line = f"# yaml-language-server: $schema={(tmp_path / 'a' / 'b' / 'sim.schema.json').as_uri()}"
    assert f"in sim/NAME.yaml write   {line}" in written.out
    # as the first line of a simulator it is not what the simulator says of itself
    (tmp_path / "my" / "sim").mkdir(parents=True)
    (tmp_path / "my" / "sim" / "tank.yaml").write_text(f"{line}\n# A tank.\nname: tank\ndt: 1\noutputs: {{y: 1}}\n")
    assert simpel(tmp_path, "sims", "tank", "--config-dir", "my").out.startswith("A tank.\n")
    (tmp_path / "file").write_text("")
    for words, message in (
        (("simm",), "schema: got simm; there are schemas of sim, data, reward, experiment. Did you mean sim?"),
        ((), "schema: name one (sim, data, reward or experiment), or write all: simpel schema --write DIR."),
        (("sim", "--write", "x"), "schema: name one"),
        (("--write", "file"), "--write: file is a file. Name a folder."),
    ):
        result = simpel(tmp_path, "schema", *words)
        assert result.code == 2
        assert message in result.err
