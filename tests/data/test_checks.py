"""Each check of the rows: what it drops, cuts or counts, and the message where it refuses."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from simpel_cli.data import Check, Measurements, Recording, read, transitions
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Declared

SPINNER = Declared(
    name="spinner",
    dt=0.1,
    states={
        "a": {"unit": "rad", "range": [-3.15, 3.15], "periodic": True},
        "w": {"unit": "rad/s", "range": [-5, 5]},
    },
    inputs={"u": {"unit": "N m", "range": [-1, 1]}},
    dynamics={"a": "w", "w": "u"},
).model()


def table(rows: int = 40, episodes: int = 2) -> dict[str, np.ndarray]:
    t = np.tile(0.1 * np.arange(rows), episodes)
    return {
        "run": np.repeat(np.arange(episodes), rows),
        "t": t,
        "a": np.sin(t),
        "w": np.cos(t),
        "u": np.sin(3 * t),
    }


def read_columns(folder: Path, columns: dict[str, Any], stored: dict[str, str] | None = None, **keys: Any) -> Recording:
    arrays = {name: pa.array(values) for name, values in columns.items()}
    fields = [
        pa.field(name, array.type, metadata={"unit": stored[name]} if stored and name in stored else None)
        for name, array in arrays.items()
    ]
    parquet.write_table(pa.table(list(arrays.values()), schema=pa.schema(fields)), folder / "d.parquet")
    defaults: dict[str, Any] = {"time": "t", "episode": "run"}
    return read(Measurements(path="d.parquet", **(defaults | keys)), SPINNER, folder, 0)


def check(recording: Recording, name: str) -> Check:
    (found,) = [check for check in recording.checks if check.name == name]
    return found


def test_clean_data_pass_every_check(tmp_path: Path) -> None:
    recording = read_columns(tmp_path, table())
    assert all(check.ok for check in recording.checks), recording.checks
    assert len({check.name for check in recording.checks}) == len(recording.checks) >= 9


def test_rows_with_nan_are_dropped_and_never_bridged(tmp_path: Path) -> None:
    columns = table()
    columns["a"][10], columns["u"][50] = np.nan, np.inf
    recording = read_columns(tmp_path, columns, max_gap=1.0)  # a wide gap is allowed, a dropped row is still a cut
    assert not check(recording, "finite").ok
    assert "2 of 80 rows dropped (NaN, inf or empty in a, u)" in check(recording, "finite").detail
    episodes = (*recording.train, *recording.test)
    assert sorted(len(e.time) for e in episodes) == [10, 10, 29, 29]
    assert {e.name for e in episodes} == {"0", "0/2", "1", "1/2"}
    assert max(np.max(np.diff(e.time)) for e in episodes) < 0.11


def test_a_last_row_without_command_still_ends_a_transition(tmp_path: Path) -> None:
    columns = table()
    columns["u"][[39, 79]] = np.nan
    recording = read_columns(tmp_path, columns)
    pairs = transitions(recording.train, 0)
    assert len(pairs.row) == 39
    assert np.isfinite(pairs.inputs).all()
    assert check(recording, "finite") == Check(
        "finite", True, "all 80 rows are finite; 2 episodes end without a command"
    )


def test_gaps_cut_an_episode(tmp_path: Path) -> None:
    columns = table()
    columns["t"][20:40] += 0.3
    recording = read_columns(tmp_path, columns)
    assert "1 gaps longer than 0.15 s" in check(recording, "gaps").detail
    assert "episode 0 at 1.9 s (0.4 s)" in check(recording, "gaps").detail
    assert sorted(len(e.time) for e in (*recording.train, *recording.test)) == [20, 20, 40]
    wider = read_columns(tmp_path, columns, max_gap=0.5)
    assert check(wider, "gaps").ok
    assert sorted(len(e.time) for e in (*wider.train, *wider.test)) == [40, 40]


@pytest.mark.parametrize(("shift", "fault"), [(-0.1, "stands still"), (-0.15, "runs backwards")])
def test_time_must_increase(tmp_path: Path, shift: float, fault: str) -> None:
    columns = table()
    columns["t"][50] += shift
    with pytest.raises(DataError, match=rf"time {fault} at row 50 \(counted from 0\) of d.parquet, episode 1") as error:
        read_columns(tmp_path, columns)
    assert error.value.exit_code == 3
    with pytest.raises(DataError, match=r"name their column: data\.episode"):
        read_columns(tmp_path, table(), episode=None, split={"by": "time"})


def test_dt_must_be_the_simulators(tmp_path: Path) -> None:
    columns = table()
    columns["t"] *= 0.5
    with pytest.raises(DataError, match=r"0.05 s apart.*has dt = 0.1 s.*data.resample: 0.1, or set sim.dt: 0.05"):
        read_columns(tmp_path, columns)
    with pytest.raises(ConfigError, match=r"data.resample: 0.2 s.*data.resample: 0.1, or sim.dt: 0.2"):
        read_columns(tmp_path, columns, resample=0.2)
    columns["t"] *= 2000
    with pytest.raises(DataError, match="looks like ms"):
        read_columns(tmp_path, columns)
    with pytest.raises(DataError, match=r"100 s apart: resampling to 0.1 s would interpolate.*looks like ms"):
        read_columns(tmp_path, columns, resample=0.1)


def test_constant_columns(tmp_path: Path) -> None:
    columns = table()
    columns["u"][:] = 0.5
    assert check(read_columns(tmp_path, columns), "constant") == Check("constant", False, "constant: u")
    columns["a"][:] = columns["w"][:] = 0.0
    with pytest.raises(DataError, match="nothing changes: a, w, u are constant over all 80 rows"):
        read_columns(tmp_path, columns)


def test_stale_rows_are_counted(tmp_path: Path) -> None:
    columns = table()
    for name in ("a", "w"):
        columns[name][1::2] = columns[name][0::2]
    detail = check(read_columns(tmp_path, columns), "stale").detail
    assert "a repeats its last value in" in detail
    assert "w repeats its last value in" in detail


def test_values_outside_the_range_are_counted_and_angles_compared_modulo_a_turn(tmp_path: Path) -> None:
    columns = table()
    columns["w"][[3, 4, 60]] = 9.0
    columns["a"] += 4 * np.pi
    detail = check(read_columns(tmp_path, columns), "ranges").detail
    assert detail == "w: 3 of 80 values outside [-5, 5] rad/s"


def test_wrapped_and_running_angles_give_the_same_motion(tmp_path: Path) -> None:
    columns = table()
    columns["a"] = 3 * columns["t"]
    running = read_columns(tmp_path, columns)
    columns["a"] = (columns["a"] + np.pi) % (2 * np.pi) - np.pi
    wrapped = read_columns(tmp_path, columns)
    np.testing.assert_allclose(wrapped.train[0].states, running.train[0].states, atol=1e-12)


@pytest.mark.parametrize("where", ["config", "file", "card"])
def test_units_must_agree(tmp_path: Path, where: str) -> None:
    if where == "card":
        (tmp_path / "card.yaml").write_text("columns: {a: {unit: degrees}}")
    stored = {"a": "deg"} if where == "file" else None
    declared = {"units": {"a": "deg"}} if where == "config" else {}
    cure = r"unit of column 'a'.* is deg.*'a' in rad\. Multiply the column by pi/180"
    with pytest.raises(DataError, match=cure) as error:
        read_columns(tmp_path, table(), stored, **declared)
    assert error.value.exit_code == 3
    # what the data YAML declares wins over what file and card say
    assert check(read_columns(tmp_path, table(), stored, units={"a": "rad"}), "units").ok


def test_units_that_are_no_angles(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"'u' in d.parquet is N, but the simulator has 'u' in N m\..*data\.units\.u"):
        read_columns(tmp_path, table(), {"u": "N"})


def test_the_card_is_among_the_files(tmp_path: Path) -> None:
    (tmp_path / "card.yaml").write_text("columns: {a: {unit: rad}}")
    assert read_columns(tmp_path, table()).files == (tmp_path / "d.parquet", tmp_path / "card.yaml")
    (tmp_path / "card.yaml").write_text("columns: [a")
    with pytest.raises(DataError, match=r"card\.yaml is not valid YAML"):
        read_columns(tmp_path, table())


def test_spellings_of_a_unit(tmp_path: Path) -> None:
    recording = read_columns(tmp_path, table(), {"u": "N*m", "w": "radians / s"})
    assert check(recording, "units").detail.startswith("2 of 3")
    with pytest.raises(DataError, match="but time is read in s"):
        read_columns(tmp_path, table(), {"t": "ms"})


def test_too_few_rows(tmp_path: Path) -> None:
    columns = table(rows=1)
    columns["a"][1] = 0.5
    with pytest.raises(DataError, match="too few rows: none of 2 rows follows another"):
        read_columns(tmp_path, columns)
    with pytest.raises(DataError, match=r"too few rows: no usable train transition.*shorter than 7 rows"):
        read_columns(tmp_path, table(rows=6), stack_actions=5)


def test_noise_estimate_of_a_known_signal(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    columns = table(rows=400, episodes=4)
    columns["a"] = np.sin(columns["t"] / 2) * 4 + rng.normal(0, 0.02, 1600)
    columns["w"] = columns["w"] + rng.normal(0, 0.3, 1600)
    noise = read_columns(tmp_path, columns).noise_std
    assert noise["a"] == pytest.approx(0.02, rel=0.15)
    assert noise["w"] == pytest.approx(0.3, rel=0.15)
    assert read_columns(tmp_path, columns, noise_std={"a": 0.5}).noise_std["a"] == 0.5


def test_noise_after_resampling_is_that_of_the_new_rows(tmp_path: Path) -> None:
    columns = table(rows=20_000, episodes=2)
    columns["t"] = columns["t"] / 10
    columns["a"] = np.sin(columns["t"]) + np.random.default_rng(2).normal(0, 0.02, 40_000)
    columns["w"] = np.cos(columns["t"])
    recording = read_columns(tmp_path, columns, resample=0.1)
    episode = recording.train[0]
    left = np.std(episode.states[:, 0] - np.sin(episode.time))
    assert left < 0.01
    assert recording.noise_std["a"] == pytest.approx(left, rel=0.15)


def irregular(wait: float) -> dict[str, np.ndarray]:
    """Rows at random times, `wait` apart on average, of a motion that is slow beside it."""
    columns = table(rows=300, episodes=4)
    rng = np.random.default_rng(0)
    columns["t"] = np.cumsum(0.02 + rng.exponential(wait - 0.02, (4, 300)), axis=1).ravel()
    columns["a"], columns["w"] = np.sin(0.5 * columns["t"]), 0.5 * np.cos(0.5 * columns["t"])
    return columns


@pytest.mark.parametrize("wait", [0.07, 0.14, 0.3])
def test_following_the_advice_for_an_irregular_clock_works(tmp_path: Path, wait: float) -> None:
    columns = irregular(wait)
    with pytest.raises(DataError, match=r"irregular") as error:
        read_columns(tmp_path, columns)
    advice = dict(re.findall(r"data\.(resample|max_gap): ([\d.]+)", str(error.value)))
    assert set(advice) == {"resample", "max_gap"}
    recording = read_columns(tmp_path, columns, **{key: float(value) for key, value in advice.items()})
    episodes = (*recording.train, *recording.test)
    assert sum(np.ptp(e.time) for e in episodes) > 0.8 * 4 * 300 * wait
    for episode in episodes:
        np.testing.assert_allclose(episode.states[:, 0], np.sin(0.5 * episode.time), atol=0.02)
    # half of the advice says what the other half is
    detail = check(read_columns(tmp_path, columns, resample=0.1), "gaps").detail
    assert "cut there" in detail
    assert f"bridged with data.max_gap: {advice['max_gap']}" in detail


def test_jitter_about_the_right_step_is_cured_by_resampling(tmp_path: Path) -> None:
    columns = table(rows=200)
    columns["t"] += np.random.default_rng(0).uniform(-0.02, 0.02, 400)
    found = check(read_columns(tmp_path, columns), "jitter")
    assert not found.ok
    assert "data.resample: 0.1 makes them equal" in found.detail
    cured = read_columns(tmp_path, columns, resample=0.1)
    assert check(cured, "jitter").ok
    np.testing.assert_allclose(np.diff(cured.train[0].time), 0.1)


def test_gaps_within_a_new_step_are_no_gaps(tmp_path: Path) -> None:
    columns = table(rows=400)
    columns["t"] /= 10
    keep = np.arange(800) % 50 != 7  # one sample of 0.01 s is missing now and then: nothing beside 0.1 s
    thinned = {name: values[keep] for name, values in columns.items()}
    recording = read_columns(tmp_path, thinned, resample=0.1)
    assert check(recording, "gaps").ok
    assert len(recording.train) + len(recording.test) == 2


@pytest.mark.parametrize("wrapped", [False, True])
def test_an_angle_in_degrees_is_suspected(tmp_path: Path, wrapped: bool) -> None:
    columns = table(rows=200)
    angle = np.degrees(2.5 * np.sin(columns["t"]))
    columns["a"] = angle % 360 if wrapped else angle
    columns["w"] = 2.5 * np.cos(columns["t"])
    recording = read_columns(tmp_path, columns)
    assert "a reaches" in check(recording, "ranges").detail
    assert "is it in degrees? Then multiply the column by pi/180 (0.0175)" in check(recording, "ranges").detail
    columns["a"] = np.radians(columns["a"])
    assert check(read_columns(tmp_path, columns), "ranges").ok


def test_a_turn_rate_in_degrees_is_suspected_and_many_turns_are_not(tmp_path: Path) -> None:
    columns = table(rows=200)
    columns["w"] = np.degrees(columns["w"])
    assert (
        "w: 380 of 400 values outside [-5, 5] rad/s: is it in degrees?"
        in check(read_columns(tmp_path, columns), "ranges").detail
    )
    columns["a"], columns["w"] = 4 * columns["t"], np.full(400, 4.0) + 0.1 * np.sin(columns["t"])  # 12 turns in 20 s
    assert check(read_columns(tmp_path, columns), "ranges").ok
    columns["u"][:] = 5 + np.sin(columns["t"])
    assert "outside [-1, 1] N m: check the unit" in check(read_columns(tmp_path, columns), "ranges").detail


def test_units_that_nobody_declares(tmp_path: Path) -> None:
    assert check(read_columns(tmp_path, table()), "units").detail == (
        "no column declares a unit: the simulator's units are assumed"
    )
    some = check(read_columns(tmp_path, table(), {"a": "rad"}), "units").detail
    assert (
        some
        == "1 of 3 columns declare a unit, the same as the simulator's; the simulator's units are assumed for the others"
    )
