"""An effect that differs from group to group, from the command line: found, given its values, and written down."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml
from command_line import TINY, simpel

CART = """name: {name}
dt: 0.05
substeps: 4
states: {{s: {{unit: m, range: [-5, 5], role: position}}, v: {{unit: m/s, range: [-4, 4], role: velocity}}}}
inputs: {{u: {{unit: V, range: [-3, 3], between_rows: held}}}}
parameters: {{b: {{unit: m/s^2/V, range: [0.6, 2.0]}}{more}}}
dynamics: {{s: v, v: {rate}}}
"""
DATA = "path: {path}\ntime: t\nepisode: episode\nsplit: {{column: split}}\n"


def test_a_drag_of_every_ball_is_found_and_fitted(tmp_path: Path) -> None:
    """Six balls with drags of their own, which the simulator lacks. What it lacks is not taken for noise with heavy tails."""
    for group in ("sim", "data"):
        (tmp_path / "my" / group).mkdir(parents=True)
    plant = CART.format(name="plant", more=", c: {unit: 1/m, range: [0.05, 2]}", rate="b*u - c*v*abs(v)")
    (tmp_path / "my/sim/plant.yaml").write_text(plant)
    (tmp_path / "my/sim/cart.yaml").write_text(CART.format(name="cart", more="", rate="b*u"))
    (tmp_path / "my/data/cart.yaml").write_text(DATA.format(path=tmp_path / "made/measurements.parquet"))
    made = simpel(
        tmp_path, "simulate", "--config-dir", "my", "sim=plant", "simulation.episodes=16", "simulation.steps=60",
        "simulation.seed=1", "simulation.noise_std={s: 0.005, v: 0.01}", "simulation.truth={b: 1.3, c: 0.4}",
        "simulation.initial={s: [-0.2, 0.2], v: [-1, 1]}",
        "simulation.groups={ball: {count: 6, parameters: {c: {law: lognormal, std: 0.5}}}}", "out=made",
    )  # fmt: skip
    assert made.code == 0, made.err
    found = simpel(
        tmp_path, "discover", "--config-dir", "my", "sim=cart", "data=cart", "effect=[quadratic_drag]",
        "effect.quadratic_drag.per=ball", "close=false", "report=false", "discovery.pairs=false", "hydra.run.dir=run",
    )  # fmt: skip
    assert found.code == 0, found.err
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    assert (verdict["verdict"], [e["name"] for e in verdict["effects"]]) == ("effect", ["quadratic_drag"])
    assert verdict["degrees_of_freedom"] == {}
    assert verdict["noise_floor"]["v"] == pytest.approx(0.01, rel=0.15)
    (group,) = verdict["groups"]
    truth = yaml.safe_load((tmp_path / "made/card.yaml").read_text())["truth_by_group"]["ball"]
    assert (group["per"], list(group["values"])) == ("ball", list(truth))
    for name, own in group["values"].items():
        assert own["value"] == pytest.approx(truth[name]["c"], rel=0.1)
    assert group["log_evidence_gain"] > 50
    arguments = pq.read_table(tmp_path / "run/residuals.parquet").column_names[-3:]
    assert arguments == ["s", "v", "u"]  # which ball a row is of is drawn as no argument of a force
    (file,) = (tmp_path / "run/conf/sim").glob("*.yaml")
    written = yaml.safe_load(file.read_text())["parameters"]["c"]
    assert written["per"] == "ball"
    assert written["spread"][0] < group["spread"]["value"] < written["spread"][1]
    for name, (low, high) in written["groups"].items():
        assert low < group["values"][name]["low"] < group["values"][name]["high"] < high
    assert list(written["groups"]) == list(truth)
    fitted = simpel(
        tmp_path, "fit", "--config-dir", "run/conf", f"sim={file.stem}", "data=cart", "hydra.run.dir=fit", *TINY
    )
    assert fitted.code == 0, fitted.err
