"""data/hidden_*: made anew they are the same, their world lacks nothing but what the truth says, and no file tells it.

The worlds and the truth lie in tests/exam, which neither the wheel nor any YAML of conf/ reaches.
"""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from command_line import ROOT, simpel
from systems import model

from simulators.model import Model
from simulators.worlds.compiled_world import CompiledWorld
from simulators.worlds.mujoco_world import MujocoWorld
from simulators.worlds.rk4 import RK4

EXAM = ROOT / "tests" / "exam"
WORLDS = {"hidden_pendulum": "mujoco_pendulum", "hidden_cart": "mujoco_cart"}
WORDS = "friction|coulomb|stiction|dry|loss|delay|delayed|late|lag|dead|effects?|truth|unmodelled|exam"


@pytest.fixture(params=WORLDS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def measured(name: str) -> dict[str, np.ndarray]:
    table = pq.read_table(ROOT / "data" / name / "measurements.parquet")
    return {column: table[column].to_numpy() for column in table.column_names}


def truth(name: str) -> dict[str, Any]:
    return json.loads((EXAM / "truth" / f"{name}.json").read_text())


def declaration(name: str) -> dict[str, Any]:
    node = yaml.safe_load((EXAM / "sim" / f"{WORLDS[name]}.yaml").read_text())
    del node["_target_"]
    return node


def world(name: str, *, effects: bool = True) -> CompiledWorld:
    node = declaration(name)
    if not effects:
        node["parameters"]["friction_loss"]["value"] = 0
        node["inputs"]["u"].pop("delay", None)
    return MujocoWorld(**node).model()


def declared(name: str) -> tuple[Model, np.ndarray]:
    """The simulator that users get, with ten times finer steps, and its true parameters."""
    content = truth(name)
    m = model(content["sim"])
    fine = dataclasses.replace(m, substeps=10 * m.substeps)
    return fine, np.array([content["parameters"][q.name]["value"] for q in m.params])


def test_made_anew_they_are_the_same(name: str, tmp_path: Path) -> None:
    words = ("--config-dir", EXAM, f"sim={WORLDS[name]}", f"simulation={name}", "out=made")
    result = simpel(tmp_path, "simulate", *words)
    assert result.code == 0, result.err
    assert (tmp_path / "made" / "card.yaml").read_text() == (ROOT / "data" / name / "card.yaml").read_text()
    table = pq.read_table(tmp_path / "made" / "measurements.parquet")
    committed = measured(name)
    assert table.column_names == list(committed)
    for column, values in committed.items():
        again = table[column].to_numpy()
        if column in ("episode", "split"):
            np.testing.assert_array_equal(again, values)
        else:  # another processor may round differently
            np.testing.assert_allclose(again, values, rtol=0, atol=1e-7)
    recipe = f"simulate $(EXAM) sim={WORLDS[name]} simulation={name} out=data/{name}\n"
    assert recipe in (ROOT / "Makefile").read_text()


def test_they_are_small_and_rich(name: str) -> None:
    columns = measured(name)
    assert (ROOT / "data" / name / "measurements.parquet").stat().st_size < 200 * 1024
    episode, split = columns["episode"], columns["split"]
    assert [len(set(episode[split == s])) for s in ("train", "test")] == [8, 3]
    sim = model(truth(name)["sim"])
    for quantity in (*sim.states, *sim.inputs):
        values = columns[quantity.name]
        assert quantity.low <= values.min() < values.max() <= quantity.high
    n = len(episode) // 11
    assert 6 <= columns["t"][:n].max() < 6.01
    speed = columns[sim.states[1].name].reshape(11, n)
    fast = np.where(np.abs(speed) > 0.1 * speed.std(), np.sign(speed), 0)
    turns = [np.count_nonzero(np.diff(row[row != 0])) for row in fast]
    assert min(turns) >= 4
    assert 0.05 < (fast == 0).mean() < 0.3  # slow often enough to see what happens at reversals


def test_the_noise_is_one_percent(name: str) -> None:
    columns = measured(name)
    card = yaml.safe_load((ROOT / "data" / name / "card.yaml").read_text())
    for state, std in card["noise_std"].items():
        values = columns[state]
        if state == "phi":  # about the hanging position
            values = values % (2 * np.pi)
        assert 0.009 < std / values.std() < 0.0115
    given = yaml.safe_load((ROOT / "conf" / "data" / f"{name}.yaml").read_text()).get("noise_std", {})
    assert given == (card["noise_std"] if name == "hidden_pendulum" else {})


def test_no_file_of_the_data_tells_what_is_missing(name: str) -> None:
    told = [ROOT / "data" / name / "card.yaml"]
    told += [ROOT / "conf" / group / f"{name}.yaml" for group in ("data", "experiment")]
    for path in told:
        assert not re.search(rf"\b({WORDS})\b", path.read_text(), re.I), path
    card = yaml.safe_load(told[0].read_text())
    assert "MuJoCo" in card["description"]
    assert {"seed", "noise_std", "excitation"} <= card.keys()
    states = [q.name for q in model(truth(name)["sim"]).states]
    assert list(measured(name)) == ["episode", "t", *states, "u", "split"]
    assert list(card["noise_std"]) == list(card["initial"]) == states


def test_no_yaml_and_no_code_reaches_the_truth() -> None:
    for folder in ("conf", "data", "simpel_cli", "simulators"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".yaml", ".py", ".xml", ".json"):
                assert not re.search(r"\btests/exam\b|mujoco_(pendulum|cart)\.yaml", path.read_text()), path


def test_the_truth_is_that_of_the_world_and_lies_in_the_declared_ranges(name: str) -> None:
    content, node = truth(name), declaration(name)
    values = {key: entry["value"] for key, entry in node["parameters"].items()}
    sim = model(content["sim"])
    assert list(content["parameters"]) == [q.name for q in sim.params]
    for quantity in sim.params:
        entry = content["parameters"][quantity.name]
        assert entry == {"value": values[quantity.name], "unit": quantity.unit}
        margin = 0.05 * (quantity.high - quantity.low)
        assert quantity.low + margin < entry["value"] < quantity.high - margin
    effects = {effect["name"]: effect["parameters"] for effect in content["effects"]}
    inertia = values["m"] * values["l"] ** 2 if name == "hidden_pendulum" else values["M"]
    assert np.isclose(effects["coulomb_friction"]["tau_c"]["value"], values["friction_loss"] / inertia, rtol=1e-6)
    assert effects.get("input_delay", {}).get("delay", {}).get("value") == node["inputs"]["u"].get("delay")
    if name == "hidden_pendulum":
        assert 0.05 < values["friction_loss"] / (values["m"] * 9.81 * values["l"]) < 0.1
        assert values["damping"] == values["drag"] == 0


def test_without_its_effects_the_world_is_the_declared_simulator(name: str) -> None:
    """Over 6 s from the measured starts under the measured inputs, to 1e-7 of the states' ranges."""
    columns, (sim, phi) = measured(name), declared(name)
    plain = world(name, effects=False)
    assert plain.dt == sim.dt
    n = len(columns["t"]) // 11
    x = np.column_stack([columns[q.name].reshape(11, n)[:, 0] for q in sim.states])
    u = columns["u"].reshape(11, n)
    paths = {"world": x, "sim": x}
    worst = np.zeros(2)
    for j in range(n - 1):
        paths["world"] = plain.step(paths["world"], u[:, j : j + 1], np.zeros((11, 0)))
        paths["sim"] = RK4(sim).step(paths["sim"], u[:, j : j + 1], np.tile(phi, (11, 1)))
        worst = np.maximum(worst, np.abs(paths["world"] - paths["sim"]).max(axis=0))
    assert (worst < 1e-7 * np.array([q.high - q.low for q in sim.states])).all()


def test_with_them_it_differs_by_what_the_truth_says(name: str) -> None:
    """One transition of the world is one of the simulator, with a constant brake and commands that come late."""
    sim, phi = declared(name)
    late = world(name)
    rng = np.random.default_rng(0)
    n = 40
    speed = rng.choice([-1, 1], n) * rng.uniform(0.4, 0.8, n) * sim.states[1].high
    x = np.column_stack([rng.uniform(q.low, q.high, n) for q in sim.states[:1]] + [speed])
    u = rng.uniform(sim.inputs[0].low, sim.inputs[0].high, (n, len(late.states) - 1))  # now, then the past commands
    after = late.step(np.column_stack([x, u[:, 1:]]), u[:, :1], np.zeros((n, 0)))
    effects = {effect["name"]: effect["parameters"] for effect in truth(name)["effects"]}
    tau = effects["coulomb_friction"]["tau_c"]["value"]
    delay = effects.get("input_delay", {}).get("delay", {}).get("value", 0.0)
    count = int(delay // sim.dt)
    expected = x
    for command, duration in ((count + 1, delay - count * sim.dt), (count, (count + 1) * sim.dt - delay)):
        if duration > 0:
            expected = braked(sim, tau, duration, phi, expected, u[:, command : command + 1])
    moving = np.sign(after[:, 1]) == np.sign(x[:, 1])
    assert moving.sum() > 30
    np.testing.assert_allclose(after[moving, :2], expected[moving], atol=2e-5)
    plain = RK4(sim).step(x, u[:, :1], np.tile(phi, (n, 1)))
    noise = yaml.safe_load((ROOT / "data" / name / "card.yaml").read_text())["noise_std"]
    assert np.abs(after[:, 1] - plain[:, 1]).mean() > 2 * noise[sim.states[1].name]


def braked(sim: Model, tau: float, duration: float, phi: np.ndarray, start: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Integrate the simulator's own right-hand side, less `tau` against the motion at the start."""
    function, x, steps = sim.function(), start, 200
    p = np.tile(phi, (len(x), 1)).T

    def rate(x: np.ndarray) -> np.ndarray:
        dx = function.map(len(x))(x.T, u.T, p)[0].full().T
        return dx - np.column_stack([np.zeros(len(x)), tau * np.sign(start[:, 1])])

    for _ in range(steps):
        middle = x + duration / steps / 2 * rate(x)
        x = x + duration / steps * rate(middle)
    return x
