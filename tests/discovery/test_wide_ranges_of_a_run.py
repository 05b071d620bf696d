"""Ranges that exclude the truth, a use and a budget, from the command line to the corrected simulator."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import process

SIM = """name: cart
dt: 0.1
states:
  s: {unit: m, range: [-40, 40]}
  v: {unit: m/s, range: [-9, 9]}
inputs:
  u: {unit: V, range: [-3, 3], between_rows: held}
parameters:
  b: {unit: m/s^2/V, range: [0.8, 1.8]}
dynamics: {s: v, v: b*u}
"""
TRUE = 2.4


def record(drift: float) -> pd.DataFrame:
    """Six carts whose gain drifts over an episode, of which the last is the test."""
    random, tables = np.random.default_rng(2), []
    for e in range(6):
        u = np.repeat(random.uniform(-3, 3, 12), 5)
        s, v = np.zeros(60), np.zeros(60)
        for i in range(59):
            a = (TRUE + drift * ((i + 0.5) / 59 - 0.5)) * u[i]
            s[i + 1], v[i + 1] = s[i] + 0.1 * v[i] + 0.005 * a, v[i] + 0.1 * a
        noise = 1e-3 * random.normal(size=(2, 60))
        tables.append(
            pd.DataFrame({"episode": e, "t": np.arange(60) * 0.1, "s": s + noise[0], "v": v + noise[1], "u": u})
        )
    table = pd.concat(tables)
    table["split"] = np.where(table.episode < 5, "train", "test")
    return table


def searched(folder: Path, drift: float, *words: str) -> dict[str, Any]:
    for name, text in (
        ("sim", SIM), ("data", "path: run.parquet\ntime: t\nepisode: episode\nsplit: {column: split}\n")
    ):  # fmt: skip
        (folder / "my" / name).mkdir(parents=True)
        (folder / "my" / name / "rig.yaml").write_text(text)
    record(drift).to_parquet(folder / "my" / "data" / "run.parquet")
    result = process(
        folder, "discover", "--config-dir", "my", "sim=rig", "data=rig", "effect=[viscous_friction,constant_load]",
        "close=false", "report=false", "hydra.run.dir=run", *words,
    )  # fmt: skip
    assert result.code == 0, result.err
    return json.loads((folder / "run" / "verdict.json").read_text())


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("wide")
    return folder, searched(folder, 0.0, "discovery.for=free_run", "discovery.simulations=true")


def test_nothing_makes_up_for_the_range(wide: tuple[Path, dict[str, Any]]) -> None:
    folder, found = wide
    assert "they ask for nothing else" in (folder / "run" / "run.log").read_text()  # nor do simulations
    assert found["verdict"] == "none"
    assert found["effects"] == []
    (outside,) = found["outside_ranges"]
    assert outside["name"] == "b"
    assert outside["range"] == [0.8, 1.8]
    assert abs(outside["value"] - TRUE) < 0.02
    assert outside["gain"] > 100
    assert "Outside the range that sim.parameters gives" in found["summary"]
    assert "where parameters differ" not in found["summary"]


def test_before_is_what_was_declared_and_after_is_the_truth(wide: tuple[Path, dict[str, Any]]) -> None:
    folder, found = wide
    assert 0.8 < found["parameters"]["b"]["before"]["low"] <= found["parameters"]["b"]["before"]["high"] <= 1.8
    table = pd.read_parquet(folder / "run" / "parameters.parquet").set_index("model")
    assert set(table["range_low"]) == {0.8}  # as declared, so that the figure shows what lies outside
    assert set(table["range_high"]) == {1.8}
    assert table.loc["before", "high"] <= 1.8 < table.loc["after", "low"]
    error = found["error"]
    assert error["after"]["free_run"]["v"] < 0.1 * error["before"]["free_run"]["v"]
    assert error["grows"] == []
    assert [step["added"] for step in found["steps"]] == [[], ["b outside its range"]]


def test_the_corrected_simulator_has_the_range(wide: tuple[Path, dict[str, Any]]) -> None:
    folder, found = wide
    node = yaml.safe_load((folder / "run" / found["corrected_sim"]).read_text())
    assert node["name"] == "cart_in_wider_ranges"
    low, high = node["parameters"]["b"]["range"]
    assert low == 0.8
    assert TRUE < high < 2.6


def test_a_drift_is_named_and_what_no_time_was_left_for_is_said(tmp_path: Path) -> None:
    found = searched(tmp_path, 0.4, "sim.parameters.b.range=[1.8,3]", "discovery.budget=1e-9")
    assert found["verdict"] == "unexplained"
    drift = found["drift"]
    assert (drift["parameter"], drift["how"]) == ("b", "over an episode")
    assert drift["size"] == pytest.approx(0.4, rel=0.15)
    assert found["remainder"]["depends_on"] == ["time"]
    assert found["remainder"]["parameter"] == found["drift"]["parameter"]
    assert "functions of two arguments" in found["left_out"]
    assert "Left out for lack of time (discovery.budget)" in found["summary"]
