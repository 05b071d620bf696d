"""A fit with an output whose sensor saturates, of a simulator with states, and its test on data of another sensor."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import CART, RIG, csv, rig, rows, simpel, swing

FEW = (
    "method=sysid",
    "method.steps=30",
    "method.starts=2",
    "method.particles=4",
    "run.figures=false",
    "run.quiet=true",
)
SIM = CART.replace("  c: 2.0\n", "  c: 2.0\n  g: {range: [0.5, 4]}\n") + "outputs:\n  y: {unit: m, expression: g*s}\n"
DATA = RIG.replace("u: volts", "u: volts, y: y") + "noise: {law: gaussian}\n"
G, NOISE, ENDS, OTHER = 2.0, 0.03, (-0.2, 0.25), (-0.1, 0.15)
HEAD = "run,t,pos,vel,volts,y"


def table(low: float, high: float, episodes: int, seed: int) -> str:
    rng = np.random.default_rng(seed)
    made = [[*row, float(np.clip(G * row[2] + NOISE * rng.normal(), low, high))] for row in swing(episodes)]
    return csv(made, HEAD)


def sensor(low: float, high: float) -> str:
    return f"sensor: {{y: {{saturates: [{low}, {high}]}}}}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saturated")
    my = rig(folder, cart=SIM, data=DATA + sensor(*ENDS), measurements=table(*ENDS, 8, 0))
    (my / "data" / "clipped.yaml").write_text(DATA)
    (my / "later.csv").write_text(table(*OTHER, 4, 1))
    for name, said in (("later", sensor(*OTHER)), ("silent", "")):
        (my / "data" / f"{name}.yaml").write_text(DATA.replace("run.csv", "later.csv") + said)
    for data, into in (("rig", "run"), ("clipped", "clipped")):
        done = simpel(folder, "fit", "--config-dir", "my", "sim=cart", f"data={data}", *FEW, f"hydra.run.dir={into}")
        assert done.code == 0, done.err
    return folder


def slope(run: Path) -> float:
    """How the predicted output goes with the position, by the test rows."""
    found = {name: np.array(column) for name, column in pq.read_table(run / "predictions.parquet").to_pydict().items()}
    positions = {(str(row[0]), row[1]): row[2] for row in swing(8)}
    kept = found["output"] == "y"
    where = zip(found["episode"][kept], found["time"][kept], strict=True)
    return float(
        np.polyfit([positions[str(episode), round(float(t), 4)] for episode, t in where], found["mean"][kept], 1)[0]
    )


def of_y(run: Path, metric: str) -> float:
    (value,) = [row["value"] for row in rows(run, split="test") if row["metric"] == metric and row["output"] == "y"]
    assert isinstance(value, float)
    return value


def test_the_gain_of_the_sensor_is_not_dragged_to_its_ends(folder: Path) -> None:
    marked, clipped = slope(folder / "run"), slope(folder / "clipped")
    print(f"g = {marked:.3f} ({G}), clipped as measured {clipped:.3f}")
    assert marked == pytest.approx(G, abs=0.12)
    assert clipped < G - 0.25


def test_other_data_have_a_sensor_of_their_own(folder: Path) -> None:
    for data in ("later", "silent"):
        done = simpel(folder, "evaluate", "run", "--config-dir", "my", f"data={data}", f"hydra.run.dir=on_{data}")
        assert done.code == 0, done.err
    told, silent = folder / "on_later", folder / "on_silent"
    assert of_y(told, "nll") < of_y(silent, "nll") - 0.5
    assert of_y(told, "crps") < 0.7 * of_y(silent, "crps")
    assert of_y(told, "rmse") < 1.3 * NOISE < of_y(silent, "rmse")
    assert 0.8 < of_y(told, "coverage_90") <= 1.0


def test_a_sensor_that_cannot_be_is_an_error(folder: Path) -> None:
    words = ("fit", "--config-dir", "my", "sim=cart", "data=rig", *FEW, "hydra.run.dir=none")
    assert simpel(folder, *words, "data.sensor={y: {saturates: [-0.2, 0.1]}}").code == 3
    assert simpel(folder, *words, "data.sensor={y: {saturates: [0.2, -0.2]}}").code == 2
    assert simpel(folder, *words, "data.sensor={u: {saturates: [-0.2, 0.1]}}").code == 2
