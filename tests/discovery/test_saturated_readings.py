"""`simpel discover` on readings that were clipped: with `data.sensor` they are left out, and drag nothing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import CART, RIG, csv, rig, simpel, swing

SIM = CART.replace("  c: 2.0\n", "  c: 2.0\n  g: {range: [0.5, 4]}\n") + "outputs:\n  y: {unit: m, expression: g*s}\n"
DATA = RIG.replace("u: volts", "u: volts, y: y") + "between_rows: {u: held}\n"
G, NOISE, LOW, HIGH = 2.0, 0.01, -0.2, 0.25
K, M, DAMPING = 20.0, 1.2, 0.5  # of the cart
FEW = ("effect=[viscous_friction,coulomb_friction]", "close=false", "run.figures=false")


def measured(substeps: int = 100) -> list[list[float]]:
    rng = np.random.default_rng(0)
    table = [[*row[:3], row[3] + 0.01 * rng.normal(), row[4]] for row in swing(6, 40, substeps=substeps)]
    return [[*row, float(np.clip(G * row[2] + NOISE * rng.normal(), LOW, HIGH))] for row in table]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two searches, one that knows of the ends of the sensor."""
    folder = tmp_path_factory.mktemp("saturated")
    said = f"sensor: {{y: {{saturates: [{LOW}, {HIGH}]}}}}\n"
    my = rig(folder, cart=SIM, data=DATA + said, measurements=csv(measured(), "run,t,pos,vel,volts,y"))
    (my / "data" / "clipped.yaml").write_text(DATA)
    for data in ("rig", "clipped"):
        words = ("--config-dir", "my", "sim=cart", f"data={data}", *FEW, f"hydra.run.dir={data}")
        done = simpel(folder, "discover", *words)
        assert done.code == 0, done.err
    return folder


def verdict(run: Path) -> dict[str, Any]:
    return json.loads((run / "verdict.json").read_text())


def test_the_effect_that_is_missing_is_named_with_its_size(folder: Path) -> None:
    found = verdict(folder / "rig")
    (effect,) = found["effects"]
    assert (effect["name"], effect["acts_on"]) == ("viscous_friction", "v")
    size = effect["parameters"]["b"]
    assert size["value"] == pytest.approx(DAMPING / M, abs=max(3 * (size["high"] - size["low"]) / 2, 0.01))
    assert found["remainder"] is None
    assert found["error"]["after"]["one_step"]["y"] < 1.3 * NOISE


def test_parameters_are_not_dragged_by_what_was_clipped(folder: Path) -> None:
    marked, clipped = (verdict(folder / data)["parameters"] for data in ("rig", "clipped"))
    for name, true in (("g", G), ("k", K), ("m", M)):
        after = marked[name]["after"]
        half = (after["high"] - after["low"]) / 2
        print(f"{name} = {after['value']:.4f} ({true}), clipped as measured {clipped[name]['after']['value']:.4f}")
        assert after["value"] == pytest.approx(true, abs=max(3 * half, 0.01 * true))
    assert clipped["g"]["after"]["value"] < 0.95 * G


def test_it_is_said_what_was_left_out(folder: Path) -> None:
    at_low, at_high = (sum(row[-1] == end for row in measured()) for end in (LOW, HIGH))
    assert min(at_low, at_high) > 20
    told = {check["check"]: check["detail"] for check in verdict(folder / "rig")["data_checks"]}["saturation"]
    assert f"(low {at_low}, high {at_high})" in told
    assert "discover leaves these values out" in told
    assert told in (folder / "rig" / "report.html").read_text()
    assert "saturation" not in {check["check"] for check in verdict(folder / "clipped")["data_checks"]}
