"""`simpel import`: what is understood of a file, what is asked, and that the YAML reads."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pyarrow import parquet
from systems import CART

from simpel_cli.config.build import build
from simpel_cli.data import Measurements, read
from simpel_cli.data.importing.draft import Draft, draft
from simpel_cli.data.importing.match import factor_between
from simpel_cli.errors import DataError
from simulators.model import Model

N = 12


def table(runs: int = 4, dt: float = 0.1, rows: int = N) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    run, i = np.repeat(np.arange(runs), rows), np.tile(np.arange(rows), runs)
    s = np.sin(0.1 * i + run) + 1e-3 * random.normal(size=len(i))
    v = np.cos(0.1 * i + run) + 1e-3 * random.normal(size=len(i))
    return {"run": run, "t": np.round(dt * i, 6), "s": s, "v": v, "u": np.where(i % 3 > 0, 1.0, -0.5)}


def csv(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(lines))


def renamed(columns: dict[str, Any], **names: str) -> dict[str, Any]:
    return {names.get(name, name): values for name, values in columns.items()}


def drafted(folder: Path, name: str = "run.csv", model: Model | None = CART) -> tuple[Draft, dict[str, Any]]:
    found = draft([name], [name], folder, model)
    node = yaml.safe_load(found.yaml)
    assert set(node) <= {"path", "time", "episode", "columns", "computed", "split", "layout"}
    return found, node


def questions(found: Draft) -> str:
    for question in found.questions:
        assert question[:30] in " ".join(found.yaml.replace("\n#", " ").split())  # they stand in the YAML as well
    return " | ".join(found.questions)


def test_everything_by_name(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", table())
    found, node = drafted(tmp_path)
    assert node == {"path": "run.csv", "time": "t", "episode": "run", "split": {"test_fraction": 0.25, "by": "episode"}}
    assert found.questions == ()
    assert found.reads
    assert "With sim cart it reads: 3 train / 1 test episodes." in found.yaml
    recording = read(build(node, "data", default=Measurements), CART, tmp_path, 0)
    assert len(recording.train) == 3


def test_without_a_simulator_the_columns_are_a_question_to_the_reader(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", table() | {"mode": ["auto"] * 48, "rate": np.ones(48)})
    found, node = drafted(tmp_path, model=None)
    assert found.reads is None
    assert "columns" not in node
    assert "# columns: {QUANTITY: COLUMN, ...}" in found.yaml
    assert "# resample: DT" in found.yaml
    assert "text: 'auto'" in found.yaml
    assert "constant, 1" in found.yaml
    read(build(node, "data", default=Measurements), CART, tmp_path, 0)


def test_by_unit_and_by_the_last_word(tmp_path: Path) -> None:
    columns = renamed(table(), s="pos [m]", v="cart.V", u="volts")
    csv(tmp_path / "run.csv", columns)
    found, node = drafted(tmp_path)
    assert node["columns"] == {"s": "pos", "v": "cart.V", "u": "volts"}
    assert found.reads
    assert "is s, by its unit alone: check it" in found.yaml
    assert "is v, by its name" in found.yaml


def test_units_are_converted(tmp_path: Path) -> None:
    columns = table()
    columns["s"] = 1000 * columns["s"]
    csv(tmp_path / "run.csv", renamed(columns, s="s [mm]", t="t [ms]") | {"t [ms]": 1000 * columns["t"]})
    found, node = drafted(tmp_path)
    assert node["computed"] == {"s_in_m": "s*1e-3", "time_s": "t*0.001"}
    assert node["columns"] == {"s": "s_in_m"}
    assert node["time"] == "time_s"
    recording = read(build(node, "data", default=Measurements), CART, tmp_path, 0)
    np.testing.assert_allclose(recording.train[0].time[1], 0.1)
    assert np.abs(recording.train[0].states).max() < 1.1
    assert found.questions == ()


@pytest.mark.parametrize(
    ("given", "wanted", "factor"),
    [
        ("deg", "rad", "pi/180"), ("deg/s", "rad/s", "pi/180"), ("rad", "deg", "180/pi"), ("mm", "m", "1e-3"),
        ("m", "mm", "1e3"), ("kN m", "N m", "1e3"), ("V/ms", "V/s", "1e3"), ("rad/ms", "rad/s", "1e3"), ("m", "V", None),
        ("m/s", "m", None), ("m2", "mm2", None), ("km/h", "m/s", None), ("g", "kg", "1e-3"),
    ],
)  # fmt: skip
def test_factors(given: str, wanted: str, factor: str | None) -> None:
    assert factor_between(given, wanted) == factor


def test_a_state_that_nothing_measures_and_an_input_that_must_be(tmp_path: Path) -> None:
    columns = table()
    del columns["v"]
    csv(tmp_path / "run.csv", columns | {"w": columns["s"] ** 2})
    found, node = drafted(tmp_path)
    assert node["columns"] == {"v": None}
    assert "Which column is v [m/s]? Is it one of w? null: it was not measured." in questions(found)
    assert found.reads  # the velocity is estimated
    del columns["u"]
    csv(tmp_path / "run.csv", columns)
    found, node = drafted(tmp_path)
    assert not found.reads
    assert "Which column is the input u [V]? No column is left for it. It has to be measured." in questions(found)
    assert "does not read yet: column 'u' is missing" in " ".join(found.yaml.split("\n# "))


def test_nothing_matches(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", renamed(table(), s="a", v="b", u="c"))
    found, node = drafted(tmp_path)
    assert "columns" not in node
    assert "# columns: {s: COLUMN, v: COLUMN, u: COLUMN}" in found.yaml
    assert len(found.questions) == 3


def test_two_columns_of_a_unit_are_not_guessed(tmp_path: Path) -> None:
    columns = renamed(table(), s="front [m]")
    csv(tmp_path / "run.csv", columns | {"rear [m]": columns["front [m]"]})
    found, node = drafted(tmp_path)
    assert node["columns"] == {"s": None}
    assert "Is it one of front, rear" in questions(found)


TIMES = {
    "ms by the simulator's dt": ("t", 100.0, "t*0.001", ""),
    "ms by its name": ("time_ms", 100.0, "time_ms*0.001", ""),
    "since 1970 in ns": ("stamp", 1e8, "stamp*1e-09", ""),
    "microseconds": ("t_us", 1e5, "t_us*1e-06", ""),
}


@pytest.mark.parametrize("case", TIMES)
def test_units_of_time(tmp_path: Path, case: str) -> None:
    name, step, formula, question = TIMES[case]
    columns = table()
    start = 1_700_000_000_000_000_000 if "1970" in case else 0
    stamps = [start + int(step) * int(i) for i in np.tile(np.arange(N), 4)]
    csv(tmp_path / "run.csv", renamed(columns, t=name) | {name: stamps})
    found, node = drafted(tmp_path)
    assert node["computed"] == {"time_s": formula}
    assert questions(found) == question
    assert found.reads


def test_s_or_ms_is_asked_where_nothing_tells(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", table() | {"t": np.tile(20 * np.arange(N), 4)})
    found, node = drafted(tmp_path, model=None)
    assert node["time"] == "t"
    assert "Is t in s or in ms? Its steps are 20" in questions(found)
    assert "`computed: {time_s: t/1000}`" in questions(found)


def test_several_candidates_for_time(tmp_path: Path) -> None:
    columns = table(runs=1)
    del columns["run"]
    stamped = renamed(columns, t="stamp") | {"clock": columns["t"] + 5}
    csv(tmp_path / "run.csv", stamped)
    found, node = drafted(tmp_path, model=None)
    assert "time" not in node
    assert "Which column is the time: stamp, clock?" in questions(found)
    csv(tmp_path / "run.csv", columns | {"clock": columns["t"] + 5})
    found, node = drafted(tmp_path)
    assert node["time"] == "t"
    assert node["split"] == {"test_fraction": 0.25, "by": "time"}  # one episode
    assert "clock could be the time as well" in questions(found)
    csv(tmp_path / "run.csv", renamed(columns, t="x"))
    assert "Is one of x, s the time? No name says so." in questions(drafted(tmp_path, model=None)[0])
    csv(tmp_path / "run.csv", {"v": columns["v"], "u": columns["u"]})
    assert "No column increases as a time does" in questions(drafted(tmp_path, model=None)[0])


def test_episodes_by_where_the_time_starts_anew(tmp_path: Path) -> None:
    columns = table() | {"half": np.repeat([0, 1], 24), "temp": np.repeat([20, 25, 30, 22], N)}
    csv(tmp_path / "run.csv", columns)
    assert drafted(tmp_path)[1]["episode"] == "run"  # temp changes there, too; its name is none of an episode
    del columns["run"]
    csv(tmp_path / "run.csv", columns)
    assert drafted(tmp_path)[1]["episode"] == "temp"
    del columns["temp"]
    csv(tmp_path / "run.csv", columns)
    found, node = drafted(tmp_path)
    assert "episode" not in node
    assert "time" not in node
    assert "t starts anew 3 times, first at line 14 of run.csv" in questions(found)
    assert "# time: t" in found.yaml


def test_gaps_jumps_wraps_and_missing_entries(tmp_path: Path) -> None:
    t = np.concatenate([0.1 * np.arange(60), 9 + 0.1 * np.arange(60)])
    angle = (2.0 * t + np.pi) % (2 * np.pi) - np.pi
    spike = np.sin(t)
    spike[40] = 50
    holes = np.cos(t)
    holes[7:9] = np.nan
    columns = {"t": t.round(6), "angle": angle, "spike": spike, "holes": ["" if np.isnan(v) else v for v in holes]}
    csv(tmp_path / "run.csv", columns)
    text = drafted(tmp_path, model=None)[0].yaml
    assert "s; steps of 0.1, 1 gaps" in text
    assert "times by a turn: an angle in rad" in text
    assert "2 jumps, the largest by 5" in text
    assert "2 entries missing" in text


def test_numbers_with_a_fault_are_asked_about(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", table())
    text = (tmp_path / "run.csv").read_text().replace(",-0.5\n", ",oops\n", 1)
    (tmp_path / "run.csv").write_text(text)
    found, _ = drafted(tmp_path, model=None)
    assert "numbers and texts" in found.yaml or "u is not read as numbers" in questions(found)


def test_a_difference_is_named(tmp_path: Path) -> None:
    columns = table(runs=1)
    columns["w"] = np.append(np.diff(columns["s"]) / 0.1, 0.0)
    csv(tmp_path / "run.csv", columns)
    assert "w is the forward difference of s, and no measurement of its own" in " ".join(
        drafted(tmp_path, model=None)[0].yaml.replace("\n#", " ").split()
    )


def test_another_dt_is_a_proposal_only(tmp_path: Path) -> None:
    csv(tmp_path / "run.csv", table(dt=0.05, rows=80))
    found, node = drafted(tmp_path)
    assert "resample" not in node
    assert "# resample: 0.1" in found.yaml
    assert not found.reads
    read(build(node | {"resample": 0.1}, "data", default=Measurements), CART, tmp_path, 0)


def test_a_split_column_and_parquet_with_units(tmp_path: Path) -> None:
    columns = table() | {"part": np.repeat(["train", "train", "test", "train"], N)}
    fields = [pa.field("omega", pa.float64(), metadata={"unit": "m/s"}) if n == "v" else n for n in columns]
    content = pa.table(renamed(columns, v="omega"))
    schema = pa.schema([f if isinstance(f, pa.Field) else content.schema.field(f) for f in fields])
    parquet.write_table(content.cast(schema), tmp_path / "run.parquet")
    found, node = drafted(tmp_path, "run.parquet")
    assert node["split"] == {"column": "part"}
    assert node["columns"] == {"v": "omega"}
    assert found.reads


def test_a_pattern_of_files(tmp_path: Path) -> None:
    for i in range(4):
        columns = table(runs=1)
        del columns["run"]
        csv(tmp_path / f"runs/run{i}_u{i}.csv", columns)
    found, node = drafted(tmp_path, "runs/run{run}_*.csv")
    assert node == {
        "path": "runs/run{run}_*.csv", "time": "t", "episode": "run", "split": {"test_fraction": 0.25, "by": "episode"}
    }  # fmt: skip
    assert found.reads
    assert dict(found.lines)["read"].startswith("4 files   48 rows")


def test_transitions(tmp_path: Path) -> None:
    columns = {name: table()[name] for name in ("s", "v", "u")}
    csv(tmp_path / "run.csv", columns | {"next_s": columns["s"] + 0.1, "next_v": columns["v"]})
    found, node = drafted(tmp_path)
    assert node["layout"] == "transitions"
    assert found.reads


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,place\na,b\nc,d\n", r"run\.csv: none of its columns holds numbers \(it has: name, place\)"),
        ("", r"run\.csv is empty"),
        ("t,t\n0,1\n", r"more than one column named t"),
        ("t,s\n", r"has a header \(t, s\) but no rows"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(DataError, match=message) as error:
        drafted(tmp_path)
    assert error.value.exit_code == 3


def test_hdf5_with_groups(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in table().items():
            file[f"{'clock' if name in ('t', 'run') else 'cart'}/{name}"] = values
    found, node = drafted(tmp_path, "run.h5")
    assert (node["time"], node["episode"]) == ("clock/t", "clock/run")
    assert node["columns"] == {"s": "cart/s", "v": "cart/v", "u": "cart/u"}
    assert found.reads


def test_fields_are_converted_too(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    columns = table()
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in columns.items():
            file[f"{'clock' if name in ('t', 'run') else 'cart'}/{name}"] = values * (1000 if name in "ts" else 1)
        file["clock/t"].attrs["unit"] = "ms"
        file["cart/s"].attrs["unit"] = "mm"
    found, node = drafted(tmp_path, "run.h5")
    assert node["computed"] == {"cart_s_in_m": "cart/s*1e-3", "time_s": "clock/t*0.001"}
    assert found.reads
