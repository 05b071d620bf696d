"""Measurements whose noise goes with the row, planted, fitted and judged with `data.noise.scale` and without."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import Result, csv, rig, simpel, swing
from scipy.stats import norm

LINE = """\
_target_: simulators.model.Declared
name: line
dt: 1.0
inputs: {x: {unit: "", range: [0.2, 4]}, z: {unit: "", range: [-1, 1]}}
parameters: {a: {range: [-5, 5]}}
outputs: {y: a*x}
"""
FEW = ("method=sysid", "method.steps=60", "method.starts=2", "method.particles=20", "run.figures=false", "run.quiet=true",
       "data.noise.law=gaussian")  # fmt: skip
SHAPE, SIZE, A, ROWS = "0.05 + 0.2*abs(y)", 0.1, 2.0, 1200


def shape(y: np.ndarray) -> np.ndarray:
    return 0.05 + 0.2 * np.abs(y)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A line with noise in proportion to its height, and one whose noise goes with another input, 40 times as large."""
    folder = tmp_path_factory.mktemp("line")
    for part in ("sim", "data"):
        (folder / "my" / part).mkdir(parents=True)
    rng = np.random.default_rng(0)
    x, z = rng.uniform(0.2, 4, ROWS), rng.uniform(-1, 1, ROWS)
    split = np.where(np.arange(ROWS) < ROWS // 2, "train", "test")
    white = np.empty(ROWS)  # a normal distribution without luck, in the low and the high half of both splits
    for rows in ((split == part) & ((x < 2.1) == low) for part in ("train", "test") for low in (True, False)):
        white[rows] = rng.permutation(norm.ppf((np.arange(rows.sum()) + 0.5) / rows.sum()))
    for name, noise in (("height", SIZE * shape(A * x)), ("other", np.exp(2 * z))):
        table = pd.DataFrame({"x": x, "z": z, "y": A * x + noise * white, "split": split})
        table.to_csv(folder / "my" / f"{name}.csv", index=False)
        data = {"path": f"../{name}.csv", "split": {"column": "split"}}
        (folder / "my" / "data" / f"{name}.yaml").write_text(yaml.safe_dump(data))
    (folder / "my" / "sim" / "line.yaml").write_text(LINE)
    return folder


def fit(folder: Path, name: str, data: str, *words: str) -> Result:
    return simpel(
        folder, "fit", "--config-dir", "my", "sim=line", f"data={data}", *FEW, *words, f"hydra.run.dir={name}"
    )


def scaled(formula: str) -> str:
    return f"data.noise.scale={{y: '{formula}'}}"


@pytest.fixture(scope="module")
def runs(folder: Path) -> Path:
    for name, words in (("without", ()), ("with", (scaled(SHAPE),))):
        done = fit(folder, name, "height", *words)
        assert done.code == 0, done.err
    return folder


def metric(run: Path, name: str) -> float:
    rows = pd.read_parquet(run / "metrics.parquet")
    rows = rows[(rows.split == "test") & (rows.metric == name) & (rows.output == "y")]
    return float(rows.value.iloc[-1])


def predictions(run: Path) -> pd.DataFrame:
    return pd.read_parquet(run / "predictions.parquet")


def test_the_nats_are_those_of_the_closed_form(runs: Path) -> None:
    """NLL per row, with the law of the noise and with one of the same variance: log rms(s) - mean log s."""
    x = pd.read_csv(runs / "my" / "height.csv").x[ROWS // 2 :]
    s = shape(A * x)
    gain = np.log(np.sqrt(np.mean(s**2))) - np.mean(np.log(s))
    assert gain > 0.1
    assert metric(runs / "without", "nll") - metric(runs / "with", "nll") == pytest.approx(gain, abs=0.02)
    entropy = 0.5 * np.log(2 * np.pi * np.e) + np.mean(np.log(SIZE * s))
    assert metric(runs / "with", "nll") == pytest.approx(entropy, abs=0.02)


def test_both_halves_are_covered_as_they_say(runs: Path) -> None:
    covered = {}
    for name in ("with", "without"):
        found = predictions(runs / name)
        inside = np.abs(found.measured - found["mean"]) <= 1.645 * found["std"]
        low = found["mean"] < 2.1 * A
        covered[name] = inside[low].mean(), inside[~low].mean()
    np.testing.assert_allclose(covered["with"], 0.9, atol=0.02)
    assert covered["without"][0] > 0.97
    assert covered["without"][1] < 0.85


def test_the_noise_that_is_told_is_that_of_a_typical_row(runs: Path) -> None:
    found = predictions(runs / "with")
    noise = np.sqrt(found["std"] ** 2 - found.epistemic_std**2)
    np.testing.assert_allclose(noise, SIZE * shape(found["mean"]), rtol=0.02)
    told = pd.read_parquet(runs / "with" / "metrics.parquet").query("metric == 'noise_std'").value.iloc[-1]
    train = pd.read_csv(runs / "my" / "height.csv").y[: ROWS // 2]
    np.testing.assert_allclose(noise / shape(found["mean"]), told / np.sqrt(np.mean(shape(train) ** 2)), rtol=1e-4)
    assert f"of y as {SHAPE}, and is given for a typical one" in (runs / "with" / "report.html").read_text()


def test_parameters_are_those_of_weighted_least_squares(folder: Path) -> None:
    """a = sum(w x y)/sum(w x^2) with variance sigma^2/sum(w x^2), w = 1/s^2."""
    for name, words in (("weighted", (scaled("exp(2*z)"),)), ("plain", ())):
        done = fit(folder, name, "other", *words)
        assert done.code == 0, done.err
    table = pd.read_csv(folder / "my" / "other.csv")
    train = table[: ROWS // 2]
    spread = {}
    for name, w in (("weighted", np.exp(-4 * train.z)), ("plain", np.ones(len(train)))):
        slope = np.sum(w * train.x * train.y) / np.sum(w * train.x**2)
        left = np.sum(w * (train.y - slope * train.x) ** 2) / len(train)
        spread[name] = np.sqrt(left / np.sum(w * train.x**2))
        found = predictions(folder / name).set_index("row")
        x = table.x[ROWS // 2 :].to_numpy()
        np.testing.assert_allclose((found["mean"] / x).median(), slope, atol=0.15 * spread[name])
        np.testing.assert_allclose((found.epistemic_std / x).median(), spread[name], rtol=0.25)
    assert spread["weighted"] < 0.5 * spread["plain"]
    assert abs((predictions(folder / "weighted")["mean"].to_numpy() / x).mean() - A) < 3 * spread["weighted"]


def test_a_scale_that_is_the_same_in_every_row_changes_nothing(runs: Path) -> None:
    name, formula = "same", "7"
    done = fit(runs, name, "height", scaled(formula))
    assert done.code == 0, done.err
    one, other = predictions(runs / name), predictions(runs / "without")
    for column in ("mean", "std", "epistemic_std"):
        np.testing.assert_allclose(one[column], other[column], rtol=2e-7)
    for each in ("nll", "crps", "coverage_90", "nrmse"):
        np.testing.assert_allclose(metric(runs / name, each), metric(runs / "without", each), rtol=1e-6)


def test_other_measurements_are_judged_with_the_noise_of_the_run(runs: Path) -> None:
    """Typical stays what it was in training, though these rows lie low."""
    low = pd.read_csv(runs / "my" / "height.csv").query("x < 1").drop(columns="split")
    low.to_csv(runs / "my" / "low.csv", index=False)
    (runs / "my" / "data" / "low.yaml").write_text("path: ../low.csv")
    for k, words in enumerate(((), (scaled(SHAPE),))):
        done = simpel(runs, "evaluate", "with", "--config-dir", "my", "data=low", *words, f"hydra.run.dir=low{k}")
        assert done.code == 0, done.err
        found, known = predictions(runs / f"low{k}"), predictions(runs / "with")
        ratio = [np.sqrt(f["std"] ** 2 - f.epistemic_std**2) / shape(f["mean"]) for f in (found, known)]
        np.testing.assert_allclose(ratio[0], ratio[1].iloc[0], rtol=1e-4)
    done = simpel(runs, "evaluate", "with", "--config-dir", "my", "data=low", scaled("1 + x"), "hydra.run.dir=low2")
    assert done.code == 2
    assert "data.noise.scale: {'y': '1 + x'}, but the run was fitted with {'y': '0.05 + 0.2*abs(y)'}" in done.err


def test_of_no_training_rows_typical_is_that_of_the_measured_ones(runs: Path) -> None:
    done = fit(runs, "prior", "height", scaled("2 + z"), "data.noise_std={y: 2}", "data.n_train=0")
    assert done.code == 0, done.err
    found, z = predictions(runs / "prior"), pd.read_csv(runs / "my" / "height.csv").z.to_numpy()
    noise = np.sqrt(found["std"] ** 2 - found.epistemic_std**2)
    train, test = z[: ROWS // 2], z[ROWS // 2 :]
    np.testing.assert_allclose(noise, 2 * (2 + test) / np.sqrt(np.mean((2 + train) ** 2)), rtol=0.02)


def test_of_no_data_typical_is_what_the_ranges_say(tmp_path: Path) -> None:
    my = rig(tmp_path)
    words = ("sim=cart", "data=rig", "data.path=[]", "data.noise_std={s: 0.01, v: 0.1}", "data.noise.scale={v: '1 + u**2'}",
             "method=sysid", "method.steps=3", "method.starts=2", "method.particles=3", "run.figures=false",
             "run.quiet=true")  # fmt: skip
    done = simpel(tmp_path, "fit", "--config-dir", "my", *words, "hydra.run.dir=run")
    assert done.code == 0, done.err
    done = simpel(tmp_path, "evaluate", "run", "--config-dir", "my", "data=rig", "hydra.run.dir=tested")
    assert done.code == 0, done.err
    found, table = predictions(tmp_path / "tested").query("output == 'v'"), pd.read_csv(my / "run.csv")
    found = found.assign(episode=found.episode.astype(int), t=found.time.round(4))
    u = found.merge(table, left_on=["episode", "t"], right_on=["run", "t"], how="left").volts.to_numpy()
    noise = np.sqrt(found["std"] ** 2 - found.epistemic_std**2).to_numpy()
    rms = np.sqrt(1 + 2 * 3 + 81 / 5)  # of 1 + u^2, u uniform between -3 and 3
    np.testing.assert_allclose(noise, 0.1 * (1 + u**2) / rms, rtol=0.05)


def test_what_is_wrong_is_said_with_its_cure(runs: Path) -> None:
    for formula, code, message in (
        ("0.1*abs(yy)", 2, "data.noise.scale.y: unknown name 'yy'; known here: x, y, z, pi. Did you mean y?"),
        ("z", 3, "data.noise.scale.y: z is no positive number in 6"),
    ):
        done = fit(runs, "wrong", "height", scaled(formula))
        assert done.code == code, done.err
        assert message in done.err
    done = fit(runs, "wrong", "height", "data.noise.scale={x: '1'}")
    assert done.code == 2
    assert "data.noise.scale.x: x is an input; only states and outputs are measured with noise." in done.err


def test_states_that_move(tmp_path: Path) -> None:
    """The change of a state has the noise of both its rows, in predictions as in free runs; a resumed run goes on with it."""
    my = rig(tmp_path)
    (my / "later.csv").write_text(csv(swing(episodes=3)))
    (my / "data" / "later.yaml").write_text((my / "data" / "rig.yaml").read_text().replace("run.csv", "later.csv"))
    words = ("sim=cart", "data=rig", "method=sysid", "method.steps=20", "method.starts=2", "method.particles=3",
             "run.figures=false", "run.quiet=true", "data.noise={law: gaussian, scale: {v: '1 + u**2'}}")  # fmt: skip
    done = simpel(tmp_path, "fit", "--config-dir", "my", *words, "hydra.run.dir=run")
    assert done.code == 0, done.err
    done = simpel(tmp_path, "evaluate", "run", "--config-dir", "my", "data=later", "hydra.run.dir=tested")
    assert done.code == 0, done.err
    typical = []
    for run, file in (("run", "run.csv"), ("tested", "later.csv")):
        found = predictions(tmp_path / run).query("output == 'v'")
        table = pd.read_csv(my / file).rename(columns={"run": "episode", "t": "time"})
        table["episode"] = table.episode.astype(str)
        found = found.assign(time=found.time.round(4)).merge(table, on=["episode", "time"])
        noise = np.sqrt(found["std"] ** 2 - found.epistemic_std**2)
        typical.append((noise / (1 + found.volts**2)).to_numpy())
        assert np.ptp(noise) > 0.3 * noise.mean()
        runs = pd.read_parquet(tmp_path / run / "trajectories.parquet").query("output == 'v'")
        runs = runs.assign(episode=runs.episode.astype(str), time=runs.time.round(4)).merge(
            table, on=["episode", "time"]
        )
        first = runs[np.isclose(runs.time, runs.start, atol=1e-6)]  # where particles do not differ yet
        np.testing.assert_allclose(first["std"] / (1 + first.volts**2), typical[0][0], rtol=1e-4)
    for each in typical:
        np.testing.assert_allclose(each, typical[0][0], rtol=1e-4)
