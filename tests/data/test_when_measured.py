"""When values were measured: planted by formula, read back. `time[row] - late` is the true instant, the value is untouched."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Episode, Measurements, Recording, read
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Declared, Model

DT = 0.01
TIE = 1e-3 * DT  # an instant so little after a row is that of the row


def rig(**outputs: Any) -> Model:
    """A pendulum with a thermometer."""
    return Declared(
        "rig", dt=DT, substeps=2,
        states={"phi": {"unit": "rad", "range": [-3, 3]}, "omega": {"unit": "rad/s", "range": [-9, 9]}},
        inputs={"u": {"unit": "V", "range": [-2, 2], "between_rows": "held"}},
        dynamics={"phi": "omega", "omega": "u - 9*phi"},
        outputs=outputs or {"T": {"unit": "K", "expression": "phi**2"}},
    ).model()  # fmt: skip


def phi(t: Any) -> Any:
    return np.sin(3 * t) + 0.2 * np.cos(11 * t)


def omega(t: Any) -> Any:
    return 3 * np.cos(3 * t) - 2.2 * np.sin(11 * t)


def temperature(t: Any) -> Any:
    return 290 + 2 * np.sin(0.7 * t)


def rows(n: int = 200, start: float = 0.0) -> dict[str, np.ndarray]:
    t = start + DT * np.arange(n)
    return {"t": t, "phi": phi(t), "omega": omega(t), "u": np.sign(np.sin(5 * t)), "T": temperature(t)}


def write(folder: Path, name: str = "rig", **columns: np.ndarray) -> str:
    path = folder / f"{name}.parquet"
    pd.DataFrame(columns).to_parquet(path)
    return str(path)


def config_of(path: str, **keys: Any) -> Measurements:
    keys["join"] = tuple(keys.get("join", ()))
    return Measurements(**({"path": path, "time": "t", "split": {"test_fraction": 0}} | keys))


def recorded(path: str, folder: Path, model: Model | None = None, *, whole: bool = False, **keys: Any) -> Recording:
    return read(config_of(path, **keys), model or rig(), folder, 0, whole=whole)


def instants(episode: Episode, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Return when the values of a column were measured, and the values."""
    values = np.concatenate([episode.states, episode.outputs], axis=1)[:, column]
    late = np.zeros(len(values)) if episode.late is None else episode.late[:, column]
    there = np.isfinite(values)
    assert np.all(late[~there] == 0)
    assert np.all(late >= 0)
    assert np.all(late[1:] <= np.diff(episode.time) + TIE)
    return (episode.time - late)[there], values[there]


def said(recording: Recording) -> str:
    (check,) = [c for c in recording.checks if c.name == "when measured"]
    assert check.ok
    return check.detail


# a latency


def test_a_value_is_late_by_a_fraction_of_a_row(tmp_path: Path) -> None:
    planted = rows() | {"phi": phi(rows()["t"] - 1.3 * DT)}
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 1.3 * DT})
    (episode,) = recording.train
    assert episode.late is not None
    when, values = instants(episode, 0)
    assert np.allclose(values, phi(when), atol=1e-12)
    assert len(values) == 199  # that of the first row was measured more than a row before it
    assert np.isnan(episode.states[-1, 0])
    assert np.allclose(episode.late[:-1, 0], 0.3 * DT)
    when, values = instants(episode, 1)
    assert np.array_equal(when, planted["t"])
    assert np.array_equal(values, planted["omega"])
    assert said(recording) == (
        "phi was measured 0.013 s before its row (data.latency.phi) (1 left out, since no row follows within a step)"
    )


@pytest.mark.parametrize("whole", [True, False])
def test_whole_rows_of_latency_shift_the_column(tmp_path: Path, whole: bool) -> None:
    planted = rows() | {"phi": phi(rows()["t"] - 3 * DT)}
    recording = recorded(write(tmp_path, **planted), tmp_path, whole=whole, latency={"phi": 3 * DT})
    (episode,) = recording.train
    assert episode.late is None
    n = 197 if whole else 200
    assert np.array_equal(episode.time, planted["t"][:n])  # the last rows lack a value: a fit drops them
    assert np.array_equal(episode.states[:197, 0], planted["phi"][3:])
    assert np.isnan(episode.states[197:, 0]).all()
    assert np.array_equal(episode.outputs[:, 0], planted["T"][:n])
    assert "phi is from 3 rows before (data.latency.phi) (3 left out" in said(recording)


def test_whole_rows_shift_also_where_time_stamps_are_rounded(tmp_path: Path) -> None:
    planted = rows() | {"t": np.round(rows()["t"] / 1.003, 4)}
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 2 * DT})
    (episode,) = recording.train
    assert episode.late is None
    assert np.array_equal(episode.states[:-2, 0], planted["phi"][2:])


def test_a_shift_does_not_cross_gaps_and_episodes(tmp_path: Path) -> None:
    planted = rows()
    planted["t"][100:] += 1.0
    planted["run"] = np.repeat([0.0, 1.0], [150, 50])
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 2 * DT}, episode="run")
    assert [len(e.time) for e in recording.train] == [100, 50, 50]
    for episode, begin in zip(recording.train, (0, 100, 150), strict=True):
        end = begin + len(episode.time)
        assert np.array_equal(episode.states[:-2, 0], planted["phi"][begin + 2 : end])
        assert np.isnan(episode.states[-2:, 0]).all()


def test_nothing_of_a_gap_gets_to_the_row_behind_it(tmp_path: Path) -> None:
    planted = rows()
    planted["t"][100:] += 1.0
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 0.4 * DT})
    before, behind = recording.train
    assert np.isfinite(before.states[0, 0])
    for episode in (before, behind):
        assert episode.late is not None
        assert np.all(episode.late <= DT)
        when, values = instants(episode, 0)
        assert set(values.tolist()) <= set(planted["phi"].tolist())
        recorded_at = dict(zip(planted["phi"].tolist(), planted["t"].tolist(), strict=True))
        assert np.allclose(when, [recorded_at[v] - 0.4 * DT for v in values.tolist()])


def test_of_two_values_of_one_row_the_later_one_stays(tmp_path: Path) -> None:
    t = np.sort(np.concatenate([DT * np.arange(100), DT * np.arange(20, 60) + 0.4 * DT]))
    planted = {"t": t, "phi": phi(t - 0.7 * DT), "omega": omega(t), "u": 0 * t, "T": temperature(t)}
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 0.7 * DT}, max_gap=0.02)
    (episode,) = recording.train
    when, values = instants(episode, 0)
    assert np.allclose(values, phi(when), atol=1e-12)
    assert np.array_equal(episode.time, t)


def test_a_latency_of_rows_without_a_time_column(tmp_path: Path) -> None:
    planted = rows() | {"T": temperature(rows()["t"] - 0.5 * DT)}
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"T": 0.5 * DT}, time=None)
    when, values = instants(recording.train[0], 2)
    assert np.allclose(values, temperature(when))


def test_a_range_is_kept_and_shifts_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, **rows())
    config = config_of(path, latency={"phi": [0, 0.05], "T": 0.02})
    assert config.latency_ranges() == {"phi": (0.0, 0.05)}
    assert config.known_latency() == {"T": 0.02}
    (episode,) = read(config, rig(), tmp_path, 0, whole=False).train
    assert np.array_equal(episode.states[:, 0], rows()["phi"])
    with pytest.raises(
        DataError, match=r"data.latency.phi: \[0, 0.05\] s is a range, which `simpel discover` estimates"
    ):
        read(config, rig(), tmp_path, 0)


def test_a_row_without_inputs_takes_no_value(tmp_path: Path) -> None:
    planted = rows()
    planted["u"] = planted["u"].copy()
    planted["u"][[50, 51]] = np.nan
    planted["phi"] = phi(planted["t"] - 0.5 * DT)
    recording = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": 0.5 * DT})
    assert [len(e.time) for e in recording.train] == [50, 148]
    for episode in recording.train:
        when, values = instants(episode, 0)
        assert np.allclose(values, phi(when), atol=1e-12)


# a sensor of the simulator


def test_the_simulator_may_say_how_late_an_output_is(tmp_path: Path) -> None:
    late = rig(T={"unit": "K", "expression": "phi**2", "delay": 0.4 * DT})
    assert late.latency == {"T": 0.4 * DT}
    path = write(tmp_path, **rows() | {"T": temperature(rows()["t"] - 0.4 * DT)})
    recording = recorded(path, tmp_path, late)
    when, values = instants(recording.train[0], 2)
    assert np.allclose(values, temperature(when))
    assert "(sim.outputs.T.delay)" in said(recording)
    recording = recorded(path, tmp_path, late, latency={"T": 2 * DT})  # data precede
    assert np.array_equal(recording.train[0].outputs[:-2, 0], temperature(rows()["t"] - 0.4 * DT)[2:])
    for off in ({"T": 0}, {"T": [0, 0.01]}):
        recording = recorded(path, tmp_path, late, latency=off)
        assert recording.train[0].late is None
        assert not [c for c in recording.checks if c.name == "when measured"]


# a clock of its own


@pytest.mark.parametrize("latency", [0.0, 0.37 * DT, 4.2 * DT])
def test_values_of_a_clock_with_offset_and_drift(tmp_path: Path, latency: float) -> None:
    planted = rows(400)
    clock = 0.003 + 2.7 * DT * (1 + 1e-3) * np.arange(200)  # when it speaks; a row holds what it said last
    last = np.searchsorted(clock, planted["t"], side="right") - 1
    planted["t_phi"] = np.where(last < 0, np.nan, clock[np.maximum(last, 0)])
    planted["phi"] = np.where(last < 0, np.nan, phi(planted["t_phi"] - latency))
    keys: dict[str, Any] = {"latency": {"phi": latency}} if latency else {}
    recording = recorded(write(tmp_path, **planted), tmp_path, times={"phi": "t_phi"}, **keys)
    (episode,) = recording.train
    when, values = instants(episode, 0)
    assert np.allclose(values, phi(when), atol=15 * TIE)
    spoken = np.unique(planted["t_phi"][np.isfinite(planted["t_phi"])]) - latency
    spoken = spoken[(spoken > -DT) & (spoken <= planted["t"][-1])]
    assert len(values) == len(spoken)
    assert np.allclose(when, spoken, atol=TIE)
    repeated = len(planted["t"]) - len(np.unique(last[last >= 0])) - int((last < 0).sum())
    assert f"'phi' by its clock 't_phi': {len(np.unique(last[last >= 0]))} values" in said(recording)
    assert f"({repeated} repeat what the sensor said before" in said(recording)


def test_a_stamp_that_stands_still_is_spoken_once(tmp_path: Path) -> None:
    planted = rows(60)
    planted["t_T"] = np.repeat(planted["t"][::6], 6)
    planted["T"] = temperature(planted["t_T"])
    recording = recorded(write(tmp_path, **planted), tmp_path, times={"T": "t_T"})
    (episode,) = recording.train
    assert episode.late is None
    assert np.array_equal(np.flatnonzero(np.isfinite(episode.outputs[:, 0])), np.arange(0, 60, 6))
    assert np.array_equal(episode.outputs[::6, 0], planted["T"][::6])


def test_dates_have_the_zero_of_the_rows(tmp_path: Path) -> None:
    planted: dict[str, Any] = rows(60)
    day = pd.Timestamp("2026-05-04T10:00:00")
    stamps = planted["t"] - 0.004
    planted["T"] = temperature(stamps)
    planted["t_T"] = day + pd.to_timedelta(stamps + 5.0, unit="s")  # its first stamp is not that of the rows
    planted["t"] = day + pd.to_timedelta(planted["t"] + 5.0, unit="s")
    recording = recorded(write(tmp_path, **planted), tmp_path, times={"T": "t_T"})
    when, values = instants(recording.train[0], 2)
    assert np.allclose(when, stamps, atol=1e-8)
    assert np.allclose(values, temperature(when), atol=1e-6)


# tables of other sensors


def slow(n: int = 25, every: float = 7.3 * DT, first: float = 0.002) -> dict[str, np.ndarray]:
    t = first + every * np.arange(n)
    return {"t": t, "T": temperature(t)}


def test_a_slow_table_is_joined(tmp_path: Path) -> None:
    main, other = rows(200), slow()
    del main["T"]
    write(tmp_path, "slow", **other)
    recording = recorded(write(tmp_path, **main), tmp_path, join=[{"path": "slow.parquet", "time": "t"}])
    (episode,) = recording.train
    assert np.array_equal(episode.time, main["t"])
    when, values = instants(episode, 2)
    assert np.allclose(when, other["t"], atol=TIE)
    assert np.array_equal(values, other["T"])
    assert [file.name for file in recording.files] == ["rig.parquet", "slow.parquet"]
    assert said(recording) == "'T' of slow.parquet: 25 values"


def test_a_late_slow_table(tmp_path: Path) -> None:
    main, other = rows(200), slow()
    del main["T"]
    other["T"] = temperature(other["t"] - 0.05)
    write(tmp_path, "slow", **other)
    recording = recorded(
        write(tmp_path, **main), tmp_path, latency={"T": 0.05}, join=[{"path": "slow.parquet", "time": "t"}]
    )
    when, values = instants(recording.train[0], 2)
    assert np.allclose(when, other["t"][1:] - 0.05, atol=TIE)
    assert np.allclose(values, temperature(when), atol=1e-6)
    assert said(recording) == (
        "'T' of slow.parquet: 25 values, 0.05 s late (data.latency.T) (1 left out, since no row follows within a step)"
    )


def test_a_fast_table_gives_every_row_its_latest_value(tmp_path: Path) -> None:
    main, other = rows(100), slow(990, DT / 10, 0.0)
    del main["T"]
    write(tmp_path, "fast", **other)
    recording = recorded(write(tmp_path, **main), tmp_path, join=[{"path": "fast.parquet", "time": "t"}])
    (episode,) = recording.train
    when, values = instants(episode, 2)
    assert np.allclose(when[:99], main["t"][:99], atol=TIE)
    assert np.allclose(values, temperature(when), atol=1e-6)
    assert "890 left out, since a later one belongs to the same row" in said(recording)  # 990 values, 100 rows


def test_columns_that_are_named_are_taken_and_all_others_are_not(tmp_path: Path) -> None:
    main, other = rows(200), slow()
    write(tmp_path, "slow", **other, extra=other["t"])
    path = write(tmp_path, **main)
    (episode,) = recorded(path, tmp_path, join=[{"path": "slow.parquet", "time": "t"}]).train
    assert episode.late is None  # T of the main table
    assert np.array_equal(episode.outputs[:, 0], main["T"])
    (episode,) = recorded(path, tmp_path, join=[{"path": "slow.parquet", "time": "t", "columns": ["T"]}]).train
    assert np.isfinite(episode.outputs[:, 0]).sum() == 25


def test_episodes_are_matched_by_name(tmp_path: Path) -> None:
    main = [rows(100) | {"run": np.full(100, name)} for name in ("a", "b")]
    other = [
        slow(12, first=first) | {"run": np.full(12, name)} for name, first in (("b", 0.004), ("a", 0.001), ("c", 0.0))
    ]
    whole = {name: np.concatenate([each[name] for each in main]) for name in main[0] if name != "T"}
    write(tmp_path, "slow", **{name: np.concatenate([each[name] for each in other]) for name in other[0]})
    recording = recorded(
        write(tmp_path, **whole), tmp_path, episode="run", join=[{"path": "slow.parquet", "time": "t"}]
    )
    assert [e.name for e in recording.train] == ["a", "b"]
    for episode, stamps in zip(recording.train, (other[1]["t"], other[0]["t"]), strict=True):
        when, values = instants(episode, 2)
        assert np.allclose(when, stamps, atol=TIE)
        assert np.array_equal(values, temperature(stamps))


def test_episodes_are_matched_by_the_names_of_files(tmp_path: Path) -> None:
    for run in (1, 2):
        folder = tmp_path / f"{run}"
        folder.mkdir()
        main = rows(100)
        del main["T"]
        write(folder, "fast", **main)
        write(folder, "slow", **slow(12, first=0.001 * run))
    recording = recorded(
        str(tmp_path / "{run}/fast.parquet"), tmp_path, episode="run", join=[{"path": "{run}/slow.parquet", "time": "t"}]
    )  # fmt: skip
    assert [e.name for e in recording.train] == ["1", "2"]
    for run, episode in enumerate(recording.train, 1):
        assert np.allclose(instants(episode, 2)[0], slow(12, first=0.001 * run)["t"], atol=TIE)
    assert len(recording.files) == 4


def test_episodes_that_do_not_overlap_are_matched_by_time(tmp_path: Path) -> None:
    main = [rows(100, start) | {"run": np.full(100, start)} for start in (0.0, 5.0)]
    whole = {name: np.concatenate([each[name] for each in main]) for name in main[0] if name != "T"}
    log = slow(100)
    write(tmp_path, "slow", **log)
    recording = recorded(
        write(tmp_path, **whole), tmp_path, episode="run", join=[{"path": "slow.parquet", "time": "t"}]
    )
    for episode, start in zip(recording.train, (0.0, 5.0), strict=True):
        when, values = instants(episode, 2)
        inside = (log["t"] > start - DT) & (log["t"] <= start + 0.99)
        assert np.allclose(when, log["t"][inside], atol=TIE)
        assert np.array_equal(values, log["T"][inside])


def test_a_fit_takes_a_joined_table_that_speaks_in_every_row(tmp_path: Path) -> None:
    main = rows(100)
    log = {"t": main["t"], "T": temperature(main["t"])}
    del main["T"]
    write(tmp_path, "log", **log)
    keys: dict[str, Any] = {"join": [{"path": "log.parquet", "time": "t"}]}
    (episode,) = recorded(write(tmp_path, **main), tmp_path, whole=True, **keys).train
    assert episode.late is None
    assert np.array_equal(episode.outputs[:, 0], log["T"])


def test_checks_of_sensors_go_on_where_no_row_is_complete(tmp_path: Path) -> None:
    main, log = rows(300), slow(40, 7.3 * DT)
    del main["T"]
    main["phi"] = 0.1 * np.round(main["phi"] / 0.1)
    write(tmp_path, "log", **log)
    recording = recorded(write(tmp_path, **main), tmp_path, join=[{"path": "log.parquet", "time": "t"}])
    checks = {c.name: c for c in recording.checks}
    assert "phi is quantised in steps of 0.1" in checks["quantisation"].detail
    assert checks["stale"].ok
    assert checks["constant"].ok
    assert checks["ranges"].ok


# partial rows for others


def test_rows_may_be_partial_for_those_who_ask(tmp_path: Path) -> None:
    path = write(tmp_path, **rows() | {"phi": phi(rows()["t"] - 0.3 * DT)})
    config = config_of(path, latency={"phi": 0.3 * DT})
    (episode,) = read(config, rig(), tmp_path, 0, whole=True, partial=True).train
    assert np.allclose(*reversed([phi(instants(episode, 0)[0]), instants(episode, 0)[1]]))
    with pytest.raises(
        DataError, match=r"rows are not complete: phi \(data.latency.phi\) was measured between rows in 200 of 200"
    ):
        read(config, rig(), tmp_path, 0, whole=False, partial=False)


def test_times_that_leave_cells_empty_are_for_discover(tmp_path: Path) -> None:
    main = rows(200)
    del main["T"]
    write(tmp_path, "slow", **slow(20, 10 * DT, 0.0))
    with pytest.raises(
        DataError, match=r"T \(data.join\[0\]\) has no value in 171 of 200 rows. `simpel discover` takes such"
    ):
        recorded(write(tmp_path, **main), tmp_path, whole=True, join=[{"path": "slow.parquet", "time": "t"}])


# irregular rows


def test_irregular_rows_keep_their_times(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    t = np.cumsum(random.uniform(0.2, 1.2, 300)) * DT
    planted = {"t": t, "phi": phi(t), "omega": omega(t), "u": np.sign(np.sin(t)), "T": temperature(t)}
    path = write(tmp_path, **planted)
    recording = recorded(path, tmp_path)
    (episode,) = recording.train
    assert np.array_equal(episode.time, t)
    checks = {c.name: c for c in recording.checks}
    assert checks["sampling"].ok
    assert "irregular steps, median" in checks["sampling"].detail
    assert checks["jitter"].ok
    with pytest.raises(DataError, match="the steps are irregular"):
        recorded(path, tmp_path, whole=True)
    with pytest.raises(DataError, match="The time looks like ms"):
        recorded(write(tmp_path, **planted | {"t": 1e3 * t * DT / np.median(np.diff(t))}), tmp_path)


# what is refused


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"latency": {"phi": -0.01}}, r"data.latency.phi: -0.01 s is not allowed: a value cannot be recorded before"),
        ({"latency": {"phi": "12 ms"}}, r"data.latency.phi: '12 ms' is not allowed, only a number of s, e.g. 0.012, or two"),
        ({"latency": {"phi": True}}, r"data.latency.phi: True is not allowed"),
        ({"latency": {"phi": [0, 0.1, 0.2]}}, r"data.latency.phi: \[0, 0.1, 0.2\] is not allowed"),
        ({"latency": {"phi": [0.1, 0.1]}}, r"data.latency.phi: \[0.1, 0.1\] is no range: its low end is not below"),
        ({"latency": {"phi": [-0.1, 0.1]}}, r"data.latency.phi: \[-0.1, 0.1\] s is not allowed"),
        ({"latency": {"phi": float("nan")}}, r"data.latency.phi: nan is not allowed"),
        ({"times": {"phi": ""}}, r"data.times.phi: '' is not the name of a column of times"),
        ({"times": {"phi": "t_phi"}, "time": None}, r"data.times.phi: the times of the rows are not known.*data.time: <name>"),
        ({"join": [{"path": "a.csv", "tim": "t"}]}, r"data.join\[0\].tim: no such key, only path, t.*Did you mean time\?"),
        ({"join": [{"time": "t"}]}, r"data.join\[0\].path: None is not allowed, only the name of a file"),
        ({"join": [{"path": "a.csv"}]}, r"data.join\[0\].time: None is not the name of a column. A table is joined by"),
        ({"join": [{"path": "a.csv", "time": "t", "columns": "T"}]}, r"data.join\[0\].columns: 'T' is not a list of columns"),
        ({"join": [{"path": "a.csv", "time": "t", "episode": 1}]}, r"data.join\[0\].episode: 1 is not the name of a column"),
        ({"join": [{"path": "a.csv", "time": "t"}], "time": None}, r"data.join\[0\]: the times of the rows of data.path are"),
    ],
)  # fmt: skip
def test_keys_that_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config_of("rig.parquet", **keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"latency": {"phy": 0.01}}, r"data.latency.phy: the simulator has no such state or output.*Did you mean phi\?"),
        ({"latency": {"u": 0.01}}, r"data.latency.u: u is an input; only states and outputs.*acts late is sim.inputs.u.delay"),
        ({"times": {"u": "t_u"}}, r"data.times.u: u is an input; the times of inputs are those of the rows"),
        ({"times": {"w": "t_u"}}, r"data.times.w: the simulator has no such state or output"),
        ({"latency": {"phi": 0.013}, "resample": DT}, r"latency.phi: 0.013 s is 1.3 rows of 0.01 s.*Leave data.resample out"),
        ({"latency": {"phi": [0, 0.1]}, "resample": DT}, r"data.latency.phi: \[0, 0.1\] s, but data.resample brings rows"),
        ({"times": {"phi": "t"}, "resample": DT}, r"data.times.phi: data.resample brings rows to another dt"),
        (
            {"latency": {"phi": 0.02}, "layout": "transitions"},
            r"data.latency.phi: rows of layout 'transitions' do not follow.*say that it is not late: data.latency=\{phi: 0\}",
        ),
        ({"join": [{"path": "rig.parquet", "time": "t", "episode": "run"}]}, r"data.join\[0\].episode: 'run', but the rows of"),
    ],
)  # fmt: skip
def test_keys_that_do_not_fit_the_rest(tmp_path: Path, keys: dict[str, Any], message: str) -> None:
    path = write(tmp_path, **rows(), next_phi=rows()["phi"], next_omega=rows()["omega"])
    with pytest.raises(ConfigError, match=message):
        recorded(path, tmp_path, **keys)


def test_resampled_rows_take_whole_rows_of_latency(tmp_path: Path) -> None:
    t = DT / 2 * np.arange(400)
    planted = {"t": t, "phi": phi(t - DT), "omega": omega(t), "u": np.sin(t), "T": temperature(t)}
    (episode,) = recorded(write(tmp_path, **planted), tmp_path, latency={"phi": DT}, resample=DT).train
    inside = slice(3, -3)
    assert np.allclose(episode.states[inside, 0], phi(episode.time)[inside], atol=0.02)


def test_a_latency_that_is_longer_than_an_episode(tmp_path: Path) -> None:
    main = [rows(n) | {"run": np.full(n, name)} for n, name in ((100, "long"), (20, "short"))]
    path = write(tmp_path, **{name: np.concatenate([each[name] for each in main]) for name in main[0]})
    message = (
        r"data.latency.phi: 0.3 s is longer than episode short, which lasts 0.19 s, so that nothing measured in it"
    )
    with pytest.raises(DataError, match=message):
        recorded(path, tmp_path, latency={"phi": 0.3}, episode="run")


def test_a_clock_that_runs_backwards(tmp_path: Path) -> None:
    planted = rows(100) | {"t_phi": rows(100)["t"]}
    planted["t_phi"] = planted["t_phi"].copy()
    planted["t_phi"][40] = 0.2
    path = write(tmp_path, **planted)
    message = (
        r"clock 't_phi' runs backwards at row 40 \(counted from 0\) of rig.parquet: 0.39 s, then 0.2 s. Sort the file"
    )
    with pytest.raises(DataError, match=message):
        recorded(path, tmp_path, times={"phi": "t_phi"})
    with pytest.raises(DataError, match=r"column 't_ph' is missing.*Did you mean t_phi\?\ndata.times.phi names it"):
        recorded(path, tmp_path, times={"phi": "t_ph"})


def test_clocks_that_never_meet(tmp_path: Path) -> None:
    planted = rows(100) | {"t_phi": rows(100)["t"] + 1.7e9}
    message = (
        r"'phi' by its clock 't_phi' and the rows of data.path have no time in common in episode 0.*from 0 to 0.99 s"
    )
    with pytest.raises(DataError, match=message):
        recorded(write(tmp_path, **planted), tmp_path, times={"phi": "t_phi"})
    day = pd.Timestamp("2026-05-04") + pd.to_timedelta(rows(100)["t"], unit="s")
    with pytest.raises(DataError, match=r"'t_phi' of rig.parquet holds dates and times, 't' numbers"):
        recorded(write(tmp_path, **planted | {"t_phi": day}), tmp_path, times={"phi": "t_phi"})


def joined(tmp_path: Path, log: dict[str, Any], main: dict[str, Any] | None = None, **keys: Any) -> Recording:
    write(tmp_path, "log", **log)
    main = {name: values for name, values in (main or rows(100)).items() if name != "T"}
    own = {"path": "log.parquet", "time": "t"} | keys.pop("own", {})
    return recorded(write(tmp_path, **main), tmp_path, join=[own], **keys)


def test_what_is_wrong_with_a_joined_table(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"'T' of log.parquet and the rows of data.path have no time in common: .* from 7.002 to"
    ):
        joined(tmp_path, slow(10, first=7.002))
    back = slow(10)
    back["t"][5] = 0.01
    with pytest.raises(
        DataError, match=r"clock 't' runs backwards at row 5 \(counted from 0\) of log.parquet: 0.294 s, then 0.01 s"
    ):
        joined(tmp_path, back)
    with pytest.raises(
        DataError,
        match=r"column 'time' is missing in log.parquet.*\nName the column of the time in data.join\[0\].time",
    ):
        joined(tmp_path, slow(10), own={"time": "time"})
    with pytest.raises(DataError, match=r"column 'temp' is missing in log.parquet.*\n.*data.join\[0\].columns"):
        joined(tmp_path, slow(10), own={"columns": ["temp"]})
    with pytest.raises(DataError, match=r"data.join\[0\]: 'lag.parquet' was not found"):
        joined(tmp_path, slow(10), own={"path": "lag.parquet"})
    day = pd.Timestamp("2026-05-04") + pd.to_timedelta(slow(10)["t"], unit="s")
    with pytest.raises(DataError, match=r"data.join\[0\].time: 't' holds dates and times, 't' numbers"):
        joined(tmp_path, slow(10) | {"t": day})


def test_an_input_in_a_joined_table(tmp_path: Path) -> None:
    main = rows(100)
    del main["u"]
    message = r"column 'u' of the input u is in log.parquet \(data.join\[0\]\).*Make that table the main one \(data.path\) and"
    with pytest.raises(DataError, match=message):
        joined(tmp_path, slow(10) | {"u": slow(10)["t"]}, main)


def test_episodes_without_a_partner(tmp_path: Path) -> None:
    main = {name: np.tile(values, 2) for name, values in rows(100).items()} | {"run": np.repeat(["a", "b"], 100)}
    with pytest.raises(
        DataError, match=r"data.join\[0\]: log.parquet has no value in episode b of data.path \(it has: a\)"
    ):
        joined(tmp_path, slow(10) | {"run": np.full(10, "a")}, main, episode="run")
    with pytest.raises(
        DataError,
        match=r"data.join\[0\]: episodes a \(0 to 0.99 s\) and b \(0 to 0.99 s\) of data.path overlap in time",
    ):
        joined(tmp_path, slow(10), main, episode="run")


def test_two_tables_with_one_column(tmp_path: Path) -> None:
    write(tmp_path, "one", **slow(10))
    write(tmp_path, "two", **slow(10))
    main = rows(100)
    del main["T"]
    with pytest.raises(
        ConfigError, match=r"data.join\[1\]: two.parquet has a column 'T', and so has one.parquet \(data.join\[0\]\)"
    ):
        recorded(
            write(tmp_path, **main),
            tmp_path,
            join=[{"path": f"{name}.parquet", "time": "t"} for name in ("one", "two")],
        )


def test_a_clock_of_a_joined_column(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.times.T: column 'T' is in the table of data.join\[0\]"):
        joined(tmp_path, slow(10), times={"T": "t"})


def test_units_of_a_joined_table_are_compared(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t [ms],T [K]\n0,290\n10,291\n")
    main = rows(100)
    del main["T"]
    path = write(tmp_path, **main)
    with pytest.raises(DataError, match=r"column 't' of log.csv is in ms, but time is read in s"):
        recorded(path, tmp_path, join=[{"path": "log.csv", "time": "t"}])
    (tmp_path / "log.csv").write_text("t [s],T [degC]\n0,290\n0.01,291\n")
    with pytest.raises(DataError, match=r"unit of column 'T' in log.csv is degC, but the simulator has 'T' in K"):
        recorded(path, tmp_path, join=[{"path": "log.csv", "time": "t"}], columns={"T": "T [degC]"})
