"""Through the shell: rows that are not whole are fitted, tables of two sensors are joined, and wrong words are named."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from command_line import csv, rig, simpel, swing

from simpel_cli.data import files

FEW = (
    "method=sysid",
    "method.steps=12",
    "method.starts=2",
    "method.particles=8",
    "run.figures=false",
    "run.quiet=true",
)
OWN = ("--config-dir", "my", "sim=cart", "data=rig")
CONFIG, DATA = 2, 3


def holes(share: float = 0.1) -> str:
    random = np.random.default_rng(2)
    return csv([[*row[:3], row[3] if random.random() > share else "", row[4]] for row in swing()])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was fitted to measurements of which a tenth of the speeds is missing."""
    folder = tmp_path_factory.mktemp("holes")
    rig(folder, measurements=holes())
    done = simpel(folder, "fit", *OWN, *FEW, "hydra.run.dir=run")
    assert done.code == 0, done.err
    return folder


def figures(run: Path) -> dict[tuple[str, str], float]:
    table = pq.read_table(run / "metrics.parquet").to_pandas()
    table = table[table["split"] == "test"]
    return {(m, o): v for m, o, v in zip(table["metric"], table["output"], table["value"], strict=True)}


def test_a_fit_with_missing_speeds_is_as_good_as_one_without(folder: Path) -> None:
    (folder / "my" / "run.csv").write_text(csv(swing()))
    done = simpel(folder, "fit", *OWN, *FEW, "hydra.run.dir=whole")
    (folder / "my" / "run.csv").write_text(holes())
    assert done.code == 0, done.err
    some, every = figures(folder / "run"), figures(folder / "whole")
    for metric in ("free_run_rmse@0.5s", "rmse"):
        assert some[metric, "s"] < 1.3 * every[metric, "s"]
    assert some["nll", "joint"] < every["nll", "joint"] + 0.5
    assert 0.7 < some["coverage_90", "joint"] <= 1
    log = (folder / "run" / "run.log").read_text()
    assert "estimated by the simulator's filter: v: " in log


def test_such_a_run_is_evaluated_resumed_and_compared(folder: Path) -> None:
    done = simpel(folder, "evaluate", "run", "hydra.run.dir=again")
    assert done.code == 0, done.err
    first, again = figures(folder / "run"), figures(folder / "again")
    assert again["nll", "joint"] == pytest.approx(first["nll", "joint"], abs=1e-6)
    assert simpel(folder, "fit", "--resume", "run").code == 0


def test_two_sensors_with_clocks_of_their_own_are_one_recording(tmp_path: Path) -> None:
    """What `simulate` plants as clocks is cut into a table of each sensor, and `fit` joins them on time."""
    my = rig(tmp_path)
    made = simpel(
        tmp_path, "simulate", "--config-dir", "my", "sim=cart", "simulation.episodes=6", "simulation.steps=40",
        "simulation.noise_std={s: 0.001, v: 0.01}", "simulation.clocks={v: {offset: 0.013, drift: 1.0e-3}}",
        "simulation.initial={s: [-0.3, 0.3], v: [-0.5, 0.5]}", "simulation.seed=3", "out=made",
    )  # fmt: skip
    assert made.code == 0, made.err
    table = pd.read_parquet(tmp_path / "made" / "measurements.parquet")
    fast = table[table["s"].notna()].drop(columns="v")
    slow = table[table["v"].notna()][["t", "episode", "v"]]
    assert 0 < len(slow) < len(table)
    assert not set(np.round(slow["t"], 9)) & set(np.round(fast["t"], 9))
    fast.to_parquet(tmp_path / "my" / "fast.parquet")
    slow.to_parquet(tmp_path / "my" / "slow.parquet")
    (my / "data" / "two.yaml").write_text(
        "path: ../fast.parquet\ntime: t\nepisode: episode\nsplit: {column: split}\n"
        "join: [{path: ../slow.parquet, time: t, episode: episode}]\n"
    )
    done = simpel(tmp_path, "fit", "--config-dir", "my", "sim=cart", "data=two", *FEW, "hydra.run.dir=run")
    assert done.code == 0, done.err
    found = figures(tmp_path / "run")
    assert found["rmse", "s"] < 0.004
    assert found["rmse", "v"] < 0.03
    assert found["free_run_rmse@1s", "s"] < 0.02


@pytest.mark.parametrize(
    ("words", "code", "fragments"),
    [
        ("data.latency={s: -0.1}", CONFIG, ("data.latency.s", "-0.1")),
        ("data.latency={s: [0.2, 0.1]}", CONFIG, ("data.latency.s", "0.2")),
        ("data.latency={u: 0.1}", CONFIG, ("data.latency.u", "sim.inputs.u.delay")),
        ("data.latency={s: 9}", DATA, ("data.latency.s", "9")),
        ("data.latency={s: [0, 0.1]}", DATA, ("data.latency.s", "simpel discover")),
        ("data.times={s: t} data.time=null", CONFIG, ("data.times",)),
        ("data.times={s: nothing}", DATA, ("nothing", "data.times.s names it")),
        ("data.join=[{pth: x.csv}]", CONFIG, ("data.join[0]", "pth")),
        ("data.join=[{path: absent.csv, time: t}]", DATA, ("absent.csv",)),
        ("data.latency={s: 0.01} data.resample=0.05", CONFIG, ("data.latency.s", "resample")),
        ("data.latency={s: 0.05} data.layout=transitions data.episode=null", CONFIG, ("data.latency.s", "transitions")),
        ("+sim.outputs.y={unit: m, expression: s, delay: -0.1}", CONFIG, ("sim.outputs.y", "delay", "-0.1", "0 or more")),
    ],
)  # fmt: skip
def test_wrong_words_about_times_are_named(tmp_path: Path, words: str, code: int, fragments: tuple[str, ...]) -> None:
    rig(tmp_path)
    split = [f"{w}" for w in words.split(" data.")]
    asked = [split[0], *(f"data.{w}" for w in split[1:])]
    done = simpel(tmp_path, "fit", *OWN, *FEW, *asked)
    assert done.code == code, (done.code, done.err)
    for fragment in fragments:
        assert fragment in done.err, done.err
    assert "Traceback" not in done.err


def test_stamps_that_stray_by_a_fifth_of_a_row(tmp_path: Path) -> None:
    """As they are, speeds would be off by about 0.03 m/s, three times the noise."""
    my = rig(tmp_path)
    made = simpel(
        tmp_path, "simulate", "--config-dir", "my", "sim=cart", "simulation.episodes=6", "simulation.steps=40",
        "simulation.noise_std={s: 0.001, v: 0.01}", "simulation.jitter=0.2",
        "simulation.initial={s: [-0.3, 0.3], v: [-0.5, 0.5]}", "simulation.seed=3", "out=made",
    )  # fmt: skip
    assert made.code == 0, made.err
    (my / "data" / "strayed.yaml").write_text(
        "path: ../../made/measurements.parquet\ntime: t\nepisode: episode\nsplit: {column: split}\n"
    )
    done = simpel(tmp_path, "fit", "--config-dir", "my", "sim=cart", "data=strayed", *FEW, "hydra.run.dir=run")
    assert done.code == 0, done.err
    found = figures(tmp_path / "run")
    assert found["rmse", "v"] < 0.02
    assert found["rmse", "s"] < 0.002
    assert "moved to even rows" in (tmp_path / "run" / "report.html").read_text()


def test_few_rows_are_read_once_and_those_that_are_whole_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """27 training rows calibrate no filter."""
    table = [[*row[:3], "" if i % 10 == 5 else row[3], row[4]] for i, row in enumerate(swing(4, 9))]
    rig(tmp_path, measurements=csv(table))
    asked, read_once = [], files.read_table

    def counted(*given: Any) -> Any:
        asked.append(given)
        return read_once(*given)

    monkeypatch.setattr(files, "read_table", counted)
    done = simpel(tmp_path, "fit", *OWN, *FEW, "hydra.run.dir=run")
    assert done.code == 0, done.err
    assert len(asked) == 1
    pairs = [i for i in range(9 * 4 - 1) if i % 9 != 8 and i % 10 != 5 and (i + 1) % 10 != 5]
    n_train = json.loads((tmp_path / "run" / "manifest.json").read_text())["n_train"]
    test = pq.read_table(tmp_path / "run" / "predictions.parquet").to_pandas().query("output == 'v'")
    assert n_train + len(test) == len(pairs)


def test_groups_and_speeds_that_are_missing(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    table = [[*r[:3], r[3] if random.random() > 0.1 else "", r[4], f"rig{int(r[0]) % 2}"] for r in swing()]
    rig(tmp_path, measurements=csv(table, "run,t,pos,vel,volts,rig"))
    done = simpel(tmp_path, "fit", *OWN, *FEW, "+sim.parameters.m.per=rig", "hydra.run.dir=run")
    assert done.code == 0, done.err
    assert figures(tmp_path / "run")["rmse", "v"] < 0.02


def test_a_sensor_without_a_value_is_named(tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    table = [[*r[:3], "" if r[0] < 6 and not (r[0] == 0 and r[1] == 0) else r[3], r[4]] for r in swing()]
    table[0][3] = ""
    rig(tmp_path, measurements=csv(table))
    done = simpel(tmp_path, "fit", *OWN, *FEW)
    assert done.code == DATA, done.err
    assert "vel" in done.err
    assert "null" in done.err
