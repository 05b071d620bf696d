"""Rows in which a sensor did not speak: discover's filter takes them as they are, and each missing value costs itself only."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Measurements, Recording, files, read
from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.discovery.search.trials import Search
from simpel_cli.errors import DataError
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.measurements.cleaning import cleaned
from simpel_cli.filtering.setup import setup
from simulators.model import Declared, Model
from simulators.worlds.simulate import Simulate

TRUTH = {"a": 1.3, "b": 2.0}


def swing() -> Model:
    return Declared(
        "swing", dt=0.05, substeps=4,
        states={"phi": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}, "omega": {"unit": "rad/s", "range": [-6, 6]}},
        inputs={"u": {"unit": "V", "range": [-2, 2], "between_rows": "held"}},
        parameters={"a": {"unit": "1/s", "range": [0.2, 3]}, "b": {"unit": "rad/s^2/V", "range": [0.5, 4]}},
        dynamics={"phi": "omega", "omega": "b*u - a*omega - 9*sin(phi)"},
    ).model()  # fmt: skip


def recorded(tmp_path, **planted) -> Recording:
    made = Simulate(
        episodes=6, steps=80, seed=1, noise_std={"phi": 0.01, "omega": 0.05}, truth=TRUTH, initial={"phi": [2, 4]}, **planted
    ).run(swing())  # fmt: skip
    path = tmp_path / "runs.parquet"
    pd.DataFrame(made.columns).to_parquet(path)
    config = Measurements(path=str(path), time="t", episode="episode", split={"column": "split"})
    return read(config, swing(), tmp_path, 0, whole=False)


def fitted(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    model = swing()
    clean = cleaned(recording, model, ()).recording
    plan = setup(model, clean, (), [], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=7))
    base = search.base().optimum
    span = plan.coordinates.high[:2] - plan.coordinates.low[:2]
    where = [base.free.index(i) for i in range(2)]
    sd = np.sqrt(np.diagonal(base.covariance)[where]) * span
    return np.array([plan.coordinates.value(i, float(base.z[i])) for i in range(2)]), sd


def test_no_episode_is_cut_and_no_row_is_lost(tmp_path) -> None:
    recording = recorded(tmp_path, missing={"phi": 0.04, "omega": 0.04})
    episodes = (*recording.train, *recording.test)
    assert [len(e.time) for e in episodes] == [80] * 6
    gone = np.concatenate([np.isnan(e.states) for e in episodes])
    assert 0.02 < gone.mean() < 0.06
    (check,) = [c for c in recording.checks if c.name == "finite"]
    assert check.ok
    assert check.detail == (
        f"missing values, each of which costs itself only: {gone[:, 0].sum()} of phi, {gone[:, 1].sum()} of omega"
    )
    for episode in episodes:  # an angle is unwrapped over what is missing
        known = episode.states[np.isfinite(episode.states[:, 0]), 0]
        assert np.max(np.abs(np.diff(known))) < 1.5
    assert np.isclose(recording.noise_std["omega"], 0.05, rtol=0.3)


@pytest.mark.parametrize("planted", [{"missing": {"phi": 0.04, "omega": 0.04}}, {"rates": {"phi": 0.2}}])
def test_parameters_are_those_that_were_planted(tmp_path, planted) -> None:
    value, sd = fitted(recorded(tmp_path, **planted))
    assert np.all(np.abs(value - list(TRUTH.values())) < 3.5 * sd)
    assert np.all(sd < 0.1)


def test_a_fit_still_takes_complete_rows_only(tmp_path) -> None:
    recorded(tmp_path, missing={"phi": 0.04})
    config = Measurements(path=str(tmp_path / "runs.parquet"), time="t", episode="episode", split={"column": "split"})
    whole = read(config, swing(), tmp_path, 0)
    assert all(np.isfinite(e.states).all() for e in whole.train)
    assert len(whole.train) > 4


def test_of_too_few_rows_those_that_are_whole_are_taken_from_the_same_reading(tmp_path, monkeypatch) -> None:
    recorded(tmp_path, missing={"phi": 0.04})
    config = Measurements(path=str(tmp_path / "runs.parquet"), time="t", episode="episode", split={"column": "split"})
    asked, read_once = [], files.read_table

    def counted(*given: Any) -> Any:
        asked.append(given)
        return read_once(*given)

    monkeypatch.setattr(files, "read_table", counted)
    whole = read(config, swing(), tmp_path, 0)
    fallen, kept = (
        read(config, swing(), tmp_path, 0, partial=True, too_few=lambda _, few=few: few) for few in (True, False)
    )
    assert len(asked) == 3
    for one, other in zip(whole.train, fallen.train, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
    assert whole.checks == fallen.checks
    assert any(np.isnan(e.states).any() for e in kept.train)


def test_a_column_without_any_value_is_refused(tmp_path) -> None:
    recorded(tmp_path)
    table = pd.read_parquet(tmp_path / "runs.parquet")
    table["omega"] = np.nan
    table.to_parquet(tmp_path / "runs.parquet")
    config = Measurements(path=str(tmp_path / "runs.parquet"), time="t", episode="episode", split={"column": "split"})
    with pytest.raises(DataError, match="'omega' has no numbers"):
        read(config, swing(), tmp_path, 0, whole=False)


def test_the_noise_of_a_slow_sensor_is_that_of_its_own_values() -> None:
    random = np.random.default_rng(0)
    signal = np.full(900, np.nan)
    signal[::9] = np.sin(np.arange(100) / 20) + 0.1 * random.normal(size=100)
    assert np.isclose(third_difference_std([signal]), 0.1, rtol=0.25)
