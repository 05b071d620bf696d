"""`simpel rl-offline` from rows with missing cells: its transitions are those that the simulator's filter made whole."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import Result, csv, rig, rows, simpel, swing

HOLD = """\
horizon: 20
reward: -s**2 - 0.01*v**2
initial: {s: [-0.3, 0.3], v: 0.0}
success: abs(s) < 0.2
settled: 5
"""
MODEL = (
    "method=sysid",
    "method.steps=12",
    "method.starts=2",
    "method.particles=4",
    "run.figures=false",
    "run.quiet=true",
)
POLICY = ("reward=hold", "sim@truth=cart", "policy.steps=400", "policy.environments=4", "policy.policies=1",
          "policy.looks=2", "policy.hidden=[8]", "control.episodes=2")  # fmt: skip
OWN = ("--config-dir", "my", "sim=cart", "data=rig")
EPISODES, ROWS, SHARE = 6, 30, 0.15


def holes(table: list[list[float]]) -> str:
    random = np.random.default_rng(2)
    return csv([[*row[:3], row[3] if random.random() > SHARE else "", row[4]] for row in table])


def learn(folder: Path, run: str, *words: str) -> Result:
    return simpel(folder, "rl-offline", *OWN, *MODEL, *POLICY, *words, f"hydra.run.dir={run}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("holes")
    my = rig(folder, measurements=holes(swing(EPISODES, ROWS)))
    (my / "reward").mkdir()
    (my / "reward" / "hold.yaml").write_text(HOLD)
    done = learn(folder, "run")
    assert done.code == 0, done.err
    return folder


def facts(run: Path) -> dict[str, Any]:
    return json.loads((run / "manifest.json").read_text())


def test_it_learns_from_every_row(folder: Path) -> None:
    test = len({str(row["episode"]) for row in pq.read_table(folder / "run/posterior/predictions.parquet").to_pylist()})
    assert facts(folder / "run")["n_train"] == (EPISODES - test) * (ROWS - 1)
    assert "estimated by the simulator's filter: v: " in (folder / "run" / "posterior" / "run.log").read_text()
    found = {row["metric"]: row["value"] for row in rows(folder / "run", split="test")}
    assert np.isfinite(found["return_in_truth"])


def test_its_posterior_is_that_of_a_fit_to_the_estimated_rows(folder: Path) -> None:
    done = simpel(folder, "fit", *OWN, *MODEL, "hydra.run.dir=fitted")
    assert done.code == 0, done.err
    own, fitted = (
        pq.read_table(run / "predictions.parquet").to_pandas()
        for run in (folder / "run" / "posterior", folder / "fitted")
    )
    for column in ("measured", "mean", "std"):
        np.testing.assert_allclose(own[column], fitted[column], rtol=1e-6)


def test_it_is_as_good_as_that_of_rows_without_holes(folder: Path) -> None:
    my = folder / "my"
    (my / "data" / "whole.yaml").write_text(
        (my / "data" / "rig.yaml").read_text().replace("../run.csv", "../whole.csv")
    )
    (my / "whole.csv").write_text(csv(swing(EPISODES, ROWS)))
    done = simpel(folder, "fit", *OWN[:-1], "data=whole", *MODEL, "hydra.run.dir=whole")
    assert done.code == 0, done.err
    some, every = (
        {row["output"]: row["value"] for row in rows(run, split="test") if row["metric"] == "rmse"}
        for run in (folder / "run" / "posterior", folder / "whole")
    )
    assert some["v"] < 1.3 * every["v"]


@pytest.mark.parametrize(
    ("words", "code", "fragments"),
    [
        (("data.latency={v: [0, 0.1]}",), 3, ("data.latency.v", "simpel discover")),
        (
            ("data.columns={s: pos, v: vel, u: volts, y: pos}", "+sim.outputs.y={unit: m, expression: s}"),
            2,
            ("data.columns", "y is measured"),
        ),
        (("data.columns={s: pos, v: vel, u: nothing}",), 3, ("nothing",)),
    ],
)  # fmt: skip
def test_where_it_cannot(words: tuple[str, ...], code: int, fragments: tuple[str, ...], folder: Path) -> None:
    done = learn(folder, "none", *words)
    assert done.code == code, (done.code, done.err)
    for fragment in fragments:
        assert fragment in done.err, done.err
    assert "Traceback" not in done.err
