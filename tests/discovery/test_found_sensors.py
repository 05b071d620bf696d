"""A sensor that reads otherwise, from the command line: found, written into the corrected simulator, and fitted with it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import TINY, simpel
from test_effects_by_group import CART, DATA

DT, B, SCALE, TAU = 0.05, 1.3, 0.15, 0.04


def carts(kind: str) -> pd.DataFrame:
    """Rows of carts, v' = B u and s' = v in closed form, whose sensor of v reads too much, or follows with a lag."""
    random, parts = np.random.default_rng(2), []
    for episode in range(14):
        u = np.repeat(random.uniform(-3, 3, 20), 3)
        s, v = random.uniform(-0.2, 0.2), random.uniform(-1, 1)
        late, rows = v, []
        for held in u:
            rows.append((s, v * (1 + SCALE) if kind == "scale" else late))
            rate, before = B * held, v
            s, v = s + v * DT + rate * DT**2 / 2, v + rate * DT
            late = v - rate * TAU + (late - before + rate * TAU) * np.exp(-DT / TAU)
        measured = np.array(rows) + random.normal(size=(len(u), 2)) * [0.005, 0.01]
        split = "train" if episode < 10 else "test"
        times = np.arange(len(u)) * DT
        parts.append(
            pd.DataFrame(
                {"episode": episode, "t": times, "s": measured[:, 0], "v": measured[:, 1], "u": u, "split": split}
            )
        )
    return pd.concat(parts)


@pytest.mark.parametrize("kind", ["scale", "lag"])
def test_is_part_of_the_corrected_simulator(kind: str, tmp_path: Path) -> None:
    for group in ("sim", "data"):
        (tmp_path / "my" / group).mkdir(parents=True)
    cart = CART.format(name="cart", more="", rate="b*u")
    # with any b, the sensor of s might as well read too little
    (tmp_path / "my/sim/cart.yaml").write_text(cart.replace("[0.6, 2.0]", "[1.25, 1.35]"))
    (tmp_path / "my/data/cart.yaml").write_text(DATA.format(path=tmp_path / "run.parquet"))
    carts(kind).to_parquet(tmp_path / "run.parquet")
    found = simpel(
        tmp_path, "discover", "--config-dir", "my", "sim=cart", "data=cart", "effect=[sensor_scale,sensor_lag]",
        "close=false", "report=false", "discovery.pairs=false", "hydra.run.dir=run",
    )  # fmt: skip
    assert found.code == 0, found.err
    verdict: dict[str, Any] = json.loads((tmp_path / "run" / "verdict.json").read_text())
    (effect,) = verdict["effects"]
    assert (effect["name"], effect["acts_on"]) == (f"sensor_{kind}", "v")
    assert verdict["corrected_sim_lacks"] == []
    file = tmp_path / "run" / verdict["corrected_sim"]
    node = yaml.safe_load(file.read_text())
    assert node["sensors"] == {"v": {"value": "v*(1 + a)"} if kind == "scale" else {"lag": "tau"}}
    name, value = ("a", SCALE) if kind == "scale" else ("tau", TAU)
    low, high = node["parameters"][name]["range"]
    assert low < value * 1.1
    assert high > value * 0.9
    assert high - low < 0.5 * value
    # a lag of 0.04 s is shown for 0.12 s and more, three rows of 0.05 s
    stack = verdict["stack_actions"]
    assert stack == (0 if kind == "scale" else 3)
    fitted = simpel(
        tmp_path, "fit", "--config-dir", "run/conf", f"sim={file.stem}", "data=cart", f"data.stack_actions={stack}",
        "hydra.run.dir=fit", *TINY,
    )  # fmt: skip
    assert fitted.code == 0, fitted.err
