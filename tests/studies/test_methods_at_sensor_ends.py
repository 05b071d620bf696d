"""Every method that trains networks, fitted to a line whose sensor saturates: beyond its end the prediction goes on."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import line, simpel

A, NOISE, HIGH, ROWS, TRAIN = 2.0, 0.2, 5.0, 120, 80
NETWORKS = ("method.steps=400", "method.particles=4", "method.network.hidden=[32,32]")
POOL = ("method.pool=64",)
SETS = (*POOL, "method.sets=16")
METHODS = {  # words that make it quick
    "simpel": (*NETWORKS, *SETS, "prior.draws=64"), "simpel_only_sim": (*NETWORKS, *SETS, "prior.draws=64"),
    "map": (*NETWORKS, *SETS, "prior.draws=64"), "repulsive": (*NETWORKS, *SETS, "prior.draws=64"),
    "pathwise": (*NETWORKS, *POOL, "prior.draws=80"),
    "fsvgd": (*NETWORKS, *SETS), "ensemble": (*NETWORKS, *SETS), "svgd": NETWORKS,
    "greybox": tuple(word.replace("method.", "method.residual.") for word in (*NETWORKS, *SETS)),
}  # fmt: skip
OF_SIMULATOR = ("simpel", "simpel_only_sim", "map", "repulsive", "pathwise")  # whose prior knows how a line goes on


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("line")
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 4, ROWS)
    y = np.minimum(A * x + NOISE * rng.normal(size=ROWS), HIGH)
    data = {"noise": {"law": "gaussian"}}
    sensor = {"sensor": {"y": {"saturates": [None, HIGH]}}}
    line(folder, x, y, TRAIN, {"marked": data | sensor, "clipped": data})
    return folder


def predicted(folder: Path, method: str, data: str) -> tuple[float, float]:
    """Mean prediction, over what it is of, well beyond the end of the sensor; mean error well below it."""
    run = f"{method}_{data}"
    words = ("--config-dir", "my", "sim=line", f"data={data}", f"method={method}", *METHODS[method])
    done = simpel(folder, "fit", *words, "run.figures=false", "run.quiet=true", f"hydra.run.dir={run}")
    assert done.code == 0, done.err
    found = pd.read_parquet(folder / run / "predictions.parquet")["mean"].to_numpy()
    true = A * pd.read_csv(folder / "my" / "line.csv").x[TRAIN:].to_numpy()
    beyond, below = true > HIGH + 1, true < HIGH - 0.5
    return float(found[beyond].mean() / true[beyond].mean()), float(np.abs(found - true)[below].mean())


@pytest.mark.parametrize("method", METHODS)
def test_predictions_go_on_beyond_the_end(method: str, folder: Path) -> None:
    """At 1.4 of the end on the mean. Functions of a prior that knows no line may go on more steeply, not less."""
    share, error = predicted(folder, method, "marked")
    print(f"{method}: {share:.3f} of the true value, error below the end {error:.3f}")
    assert 0.93 < share < (1.05 if method in OF_SIMULATOR else 1.2)
    assert error < 0.6 * NOISE


def test_taken_as_measured_they_stay_at_the_end(folder: Path) -> None:
    share, _ = predicted(folder, "simpel", "clipped")
    assert share < 0.75
