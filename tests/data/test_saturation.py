"""Sensors that saturate: what is read, refused and carried along."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Measurements, Recording, read, transitions
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.filtering.measurements.cleaning import cleaned, without_computed
from simpel_cli.filtering.measurements.windows import windows_of
from simulators.model import Declared, Model
from simulators.worlds.simulate import Simulate

LOW, HIGH = -1.0, 1.5


def cart() -> Model:
    return Declared(
        "cart", dt=0.05, states={"v": {"unit": "m/s", "range": [-4, 4]}},
        inputs={"u": {"unit": "N", "range": [-3, 3], "between_rows": "held"}},
        parameters={"a": {"unit": "1/s", "range": [0.5, 2]}}, dynamics={"v": "u - a*v"},
        outputs={"w": {"unit": "m/s", "expression": "3*v"}, "y": {"unit": "m/s", "expression": "2*v"}},
    ).model()  # fmt: skip


def recorded(folder: Path, saturates: dict[str, Any], planted: dict[str, Any] | None = None, **keys: Any) -> Recording:
    made = Simulate(
        episodes=4, steps=60, seed=2, noise_std={"v": 0.01, "w": 0.01, "y": 0.02}, truth={"a": 1.0},
        saturates=saturates if planted is None else planted,
    ).run(cart())  # fmt: skip
    path = folder / "runs.parquet"
    pd.DataFrame(made.columns).to_parquet(path)
    whole = keys.pop("whole", True)
    sensor = {name: {"saturates": ends} for name, ends in saturates.items()}
    config = Measurements(path=str(path), time="t", episode="episode", split={"column": "split"}, sensor=sensor, **keys)
    return read(config, cart(), folder, 0, whole=whole)


def check(recording: Recording, name: str = "saturation") -> str:
    return next(c.detail for c in recording.checks if c.name == name)


def test_outputs_at_an_end_are_marked_and_carried_along(tmp_path: Path) -> None:
    recording = recorded(tmp_path, {"y": [LOW, HIGH]})
    episodes = (*recording.train, *recording.test)
    for e in episodes:
        assert e.beyond is not None
        assert np.array_equal(
            e.beyond[:, 2], np.where(e.outputs[:, 1] == HIGH, 1, np.where(e.outputs[:, 1] == LOW, -1, 0))
        )
        assert not e.beyond[:, :2].any()
    share = np.mean(np.concatenate([e.beyond[:, 2] for e in episodes if e.beyond is not None]) != 0)
    assert 0.1 < share < 0.9
    assert f"y {share:.2%} (low " in check(recording)
    pairs = transitions(recording.train, 0)
    assert np.array_equal(pairs.beyond[:, 2] != 0, np.isin(pairs.outputs[:, 1], [LOW, HIGH]))
    half = pairs.take(np.arange(len(pairs.row)) % 2 == 0)
    assert np.array_equal(half.beyond[:, 2] != 0, np.isin(half.outputs[:, 1], [LOW, HIGH]))
    assert all(c.ok for c in recording.checks if c.name in ("stale", "quantisation"))


def test_a_state_at_an_end_is_missing(tmp_path: Path) -> None:
    whole = recorded(tmp_path, {"v": [None, 0.5]})
    assert "taken for missing values: it is a state" in check(whole)
    assert max(e.states.max() for e in whole.train) < 0.5
    partial = recorded(tmp_path, {"v": [None, 0.5]}, whole=False)
    marks = [np.zeros((60, 3)) if e.beyond is None else e.beyond for e in partial.train]
    assert sum(mark.sum() for mark in marks) > 10
    for e, mark in zip(partial.train, marks, strict=True):
        assert np.array_equal(np.isnan(e.states[:, 0]), mark[:, 0] == 1)


def test_the_filter_leaves_them_out(tmp_path: Path) -> None:
    recording = recorded(tmp_path, {"y": [LOW, HIGH]}, whole=False, derived=("w",))
    assert recording.derived == ("w",)
    narrow = without_computed(recording, cart())  # columns of outputs are cut, and their marks with them
    assert narrow.outputs == ("y",)
    (e, mark) = (narrow.train[0], recording.train[0].beyond)
    assert mark is not None
    assert e.beyond is not None
    assert np.array_equal(e.beyond, mark[:, [0, 2]])
    made = windows_of(narrow.train, ["v"], ("v", "y"), ("y",), np.zeros(1), np.ones(1), lead=0, dt=0.05)
    assert np.array_equal(made.ok[0, :, 1] == 0, mark[:, 2] != 0)
    clean = cleaned(recording, cart(), ()).recording
    assert np.array_equal(np.isnan(clean.train[0].outputs[:, 0]), mark[:, 2] != 0)


def test_rows_that_stand_alone(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    v, u = rng.uniform(-1, 1, 40), rng.uniform(-1, 1, 40)
    after = np.maximum(v + 0.05 * (u - v), -0.9)
    columns = {"u": u, "v": np.maximum(v, -0.9), "next_v": after, "w": 3 * v, "y": np.clip(2 * v, LOW, HIGH)}
    path = tmp_path / "pairs.csv"
    sensor = {"y": {"saturates": [LOW, HIGH]}, "v": {"saturates": [-0.9, None]}}
    pd.DataFrame(columns).to_csv(path)
    config = Measurements(
        path=str(path), layout="transitions", sensor=sensor, split={"test_fraction": 0.25, "by": "time"}
    )
    recording = read(config, cart(), tmp_path, 0)
    pairs = transitions((*recording.train, *recording.test), 0)
    assert len(pairs.row) == np.sum((v > -0.9) & (after > -0.9)) < 40
    assert np.array_equal(pairs.beyond[:, 2] != 0, np.isin(pairs.outputs[:, 1], [LOW, HIGH]))


def test_a_held_end_is_no_stale_sensor(tmp_path: Path) -> None:
    """A square wave that reaches both ends repeats them, and moves by much in between."""
    t = 0.05 * np.arange(400)
    v = np.where(np.arange(400) % 8 < 4, -2.0, 2.0) + 0.3 * np.random.default_rng(0).normal(size=400)
    columns = {"t": t, "u": np.sin(t), "v": v, "w": 3 * v, "y": np.clip(2 * v, LOW, HIGH)}
    columns["y"][::9] = 0.3 * np.random.default_rng(1).normal(size=len(t[::9]))
    path = tmp_path / "square.parquet"
    pd.DataFrame(columns).to_parquet(path)

    def said(**keys: Any) -> bool:
        config = Measurements(path=str(path), time="t", split={"test_fraction": 0.25, "by": "time"}, **keys)
        return next(c.ok for c in read(config, cart(), tmp_path, 0).checks if c.name == "stale")

    assert not said()
    assert said(sensor={"y": {"saturates": [LOW, HIGH]}})


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ({"y": {"saturates": [2, 1]}}, "data.sensor.y.saturates: [2, 1] is no range"),
        ({"y": {"saturates": [1, 1]}}, "is no range"),
        ({"y": {"saturates": "high"}}, "data.sensor.y.saturates: 'high' is not allowed, only [low, high]"),
        ({"y": {"saturates": [1]}}, "only [low, high]"),
        ({"y": {"saturates": [0, True]}}, "only [low, high]"),
        ({"y": {"saturates": [0, float("nan")]}}, "only [low, high]"),
        ({"y": [0, 1]}, "data.sensor.y: [0, 1] is not allowed, only e.g. {saturates: [0, 10]}"),
        ({"y": {"saturate": [0, 1]}}, "data.sensor.y.saturate: no such key, only saturates."),
        ({"z": {"saturates": [0, 1]}}, "data.sensor.z: the simulator has no such state or output"),
        ({"u": {"saturates": [0, 1]}}, "data.sensor.u: u is an input"),
    ],
)
def test_keys_that_are_refused(sensor: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Measurements(path="a.csv", sensor=sensor).check_names(("v", "w", "y", "u"), ("v", "w", "y"))
    assert message in str(caught.value)


def test_values_beyond_the_ends_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        recorded(tmp_path, {"y": [LOW, HIGH]}, planted={"y": [LOW, HIGH + 0.5]})
    said = str(caught.value)
    assert "data.sensor.y.saturates: [-1, 1.5], but " in said
    assert " of 240 values of y lie beyond, from 1.5" in said
    assert "to 2: the sensor records nothing there. Correct the ends" in said


def test_rounding_is_no_value_beyond(tmp_path: Path) -> None:
    recording = recorded(tmp_path, {"y": [LOW, HIGH * (1 - 2e-10)]}, planted={"y": [LOW, HIGH]})
    outputs = np.concatenate([e.outputs[:, 1] for e in recording.train])
    assert outputs.max() == HIGH * (1 - 2e-10)


def test_values_at_an_end_cannot_be_resampled(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data\.resample: .* of the values of y lie at an end of its sensor"):
        recorded(tmp_path, {"y": [LOW, HIGH]}, resample=0.05)
