"""Several files as one table: episodes that never merge, whole files as the test split, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from simpel_cli.config.build import build
from simpel_cli.data import Measurements, Recording, absolute, read, transitions
from simpel_cli.errors import ConfigError, DataError
from simulators.model import Declared

DECAY = Declared(
    name="decay", dt=1.0, states={"x": {"unit": "m", "range": [0, 1000]}}, dynamics={"x": "-x"}, outputs={"y": "x"}
).model()


def write(
    folder: Path, name: str, first: int, runs: tuple[int, ...] = (0,), rows: int = 6, head: str = "run,t,x"
) -> None:
    lines = [head]
    for run in runs:
        lines += [f"{run},{i},{first + 10 * run + i}" for i in range(rows)]
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("\n".join(lines))


def read_files(folder: Path, *names: str, **keys: Any) -> Recording:
    defaults: dict[str, Any] = {"time": "t", "episode": "run", "split": {"test_files": [names[-1]]}}
    return read(Measurements(names, **(defaults | keys)), DECAY, folder, 0)


def firsts(recording: Recording) -> tuple[dict[str, float], dict[str, float]]:
    """First value of every episode by name: train, test."""
    return tuple({e.name: float(e.states[0, 0]) for e in part} for part in (recording.train, recording.test))  # type: ignore[return-value]


def test_names_that_collide_get_the_stem_of_their_file(tmp_path: Path) -> None:
    write(tmp_path, "train.csv", 100, runs=(0, 1))
    write(tmp_path, "test.csv", 500)
    recording = read_files(tmp_path, "train.csv", "test.csv")
    assert firsts(recording) == ({"train:0": 100, "train:1": 110}, {"test:0": 500})
    assert recording.files == (tmp_path / "train.csv", tmp_path / "test.csv")
    assert len(transitions(recording.train, 0).row) == 2 * 5  # none from one file into the next


def test_names_that_differ_stay(tmp_path: Path) -> None:
    write(tmp_path, "train.csv", 100, runs=(0, 1))
    write(tmp_path, "test.csv", 500, runs=(2,))
    assert firsts(read_files(tmp_path, "train.csv", "test.csv")) == ({"0": 100, "1": 110}, {"2": 520})


def test_without_an_episode_column_a_file_is_an_episode(tmp_path: Path) -> None:
    write(tmp_path, "a/run.csv", 100)
    write(tmp_path, "b/run.csv", 300)
    write(tmp_path, "c/last.csv", 500)
    recording = read_files(tmp_path, "a/run.csv", "b/run.csv", "c/last.csv", episode=None)
    assert firsts(recording) == ({"a-run": 100, "b-run": 300}, {"c-last": 500})


def test_a_row_without_an_episode_is_still_dropped(tmp_path: Path) -> None:
    for name, first in (("train.csv", 100), ("test.csv", 500)):
        write(tmp_path, name, first)
        with (tmp_path / name).open("a") as file:
            file.write("\n,6,7")
    recording = read_files(tmp_path, "train.csv", "test.csv")
    assert [check.detail[:18] for check in recording.checks if check.name == "finite"] == ["2 of 14 rows dropp"]


def test_other_splits_work_on_several_files(tmp_path: Path) -> None:
    write(tmp_path, "a.csv", 100, head="part,t,x")
    write(tmp_path, "b.csv", 500, runs=(1,), head="part,t,x")
    for name, part in (("a.csv", "test"), ("b.csv", "train")):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text.replace("\n0,", f"\n{part},").replace("\n1,", f"\n{part},"))
    recording = read_files(tmp_path, "a.csv", "b.csv", episode=None, split={"column": "part"})
    assert firsts(recording) == ({"b": 510}, {"a": 100})
    by_episode = read_files(tmp_path, "a.csv", "b.csv", episode=None, split={"by": "episode"})
    assert len(by_episode.train) == len(by_episode.test) == 1


def test_parquet_beside_csv_and_units_of_every_file(tmp_path: Path) -> None:
    write(tmp_path, "a.csv", 100)
    fields = [
        pa.field(name, pa.float64(), metadata={"unit": "mm"} if name == "x" else None) for name in ("run", "t", "x")
    ]
    columns = [pa.array(np.arange(6.0)) for _ in fields]
    parquet.write_table(pa.table(columns, schema=pa.schema(fields)), tmp_path / "a.parquet")
    with pytest.raises(DataError, match=r"unit of column 'x' in a\.parquet is mm, but the simulator has 'x' in m"):
        read_files(tmp_path, "a.csv", "a.parquet")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("run,t,z", r"column 'z' is missing in train\.csv, but test\.csv has it \(train\.csv has: run, t, x\)\."),
        ("run,time,x", r"column 'time' is missing in train\.csv, but test\.csv has it"),
        ("run,t,X", r"need the same columns: rename, add or remove it"),
    ],
)
def test_columns_must_be_the_same(tmp_path: Path, head: str, message: str) -> None:
    write(tmp_path, "train.csv", 100)
    write(tmp_path, "test.csv", 500, head=head)
    with pytest.raises(DataError, match=message) as error:
        read_files(tmp_path, "train.csv", "test.csv")
    assert error.value.exit_code == 3


def test_a_measured_output_is_not_lost_silently(tmp_path: Path) -> None:
    write(tmp_path, "train.csv", 100)
    (tmp_path / "test.csv").write_text("run,t,x,y\n" + "".join(f"0,{i},{i},{i}\n" for i in range(6)))
    with pytest.raises(DataError, match=r"column 'y' is missing in train\.csv, but test\.csv has it"):
        read_files(tmp_path, "train.csv", "test.csv")


def test_a_fault_names_its_file_and_line(tmp_path: Path) -> None:
    write(tmp_path, "train.csv", 100)
    write(tmp_path, "test.csv", 500)
    text = (tmp_path / "test.csv").read_text()
    (tmp_path / "test.csv").write_text(text.replace("0,4,504", "0,2,504"))
    with pytest.raises(DataError, match=r"time runs backwards at line 6 of test\.csv, episode test:0: 3 s, then 2 s"):
        read_files(tmp_path, "train.csv", "test.csv")
    (tmp_path / "test.csv").write_text(text.replace("504", "oops"))
    with pytest.raises(DataError, match=r"column 'x' of test\.csv should hold numbers, but line 6 has 'oops'"):
        read_files(tmp_path, "train.csv", "test.csv")


@pytest.mark.parametrize(
    ("test_files", "message"),
    [
        (
            ["tets.csv"],
            r"test_files: 'tets\.csv' is none of the files of data\.path \(train\.csv, run\.csv, run\.csv\)",
        ),
        (["run.csv"], r"'run\.csv' stands for 2 files; give more of its path"),
        (
            ["train.csv", "a/run.csv", "b/run.csv"],
            r"are all the files of data\.path, so that nothing is left to train on",
        ),
    ],
)
def test_test_files_that_do_not_fit(tmp_path: Path, test_files: list[str], message: str) -> None:
    for name in ("train.csv", "a/run.csv", "b/run.csv"):
        write(tmp_path, name, 100)
    with pytest.raises(ConfigError, match=message):
        read_files(tmp_path, "train.csv", "a/run.csv", "b/run.csv", split={"test_files": test_files})
    by_path = read_files(tmp_path, "train.csv", "a/run.csv", "b/run.csv", split={"test_files": ["a/run.csv"]})
    assert [e.name for e in by_path.test] == ["a-run:0"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"path": ["a.csv", ""]}, r"data\.path: .* is not allowed"),
        ({"path": ["a.csv"], "split": {"test_files": "a.csv"}}, r"test_files: 'a\.csv' is not a list of files"),
        ({"path": "a.csv", "split": {"test_files": ["a.csv"], "by": "time"}}, r"data\.split: .* is not allowed, only"),
    ],
)
def test_wrong_values_of_the_yaml(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(keys, "data", default=Measurements)


def test_a_file_named_twice(tmp_path: Path) -> None:
    write(tmp_path, "run.csv", 100)
    with pytest.raises(DataError, match=r"run\.csv is named twice"):
        read_files(tmp_path, "run.csv", "./run.csv")


def test_a_kept_configuration_finds_its_files_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, "train.csv", 100)
    write(tmp_path, "far/run.csv", 500)
    node = {
        "path": ["train.csv", "far/run.csv"],
        "split": {"test_files": ["far/run.csv"]},
        "time": "t",
        "episode": "run",
    }
    kept = absolute(node, tmp_path)
    assert kept["path"] == [str(tmp_path / "train.csv"), str(tmp_path / "far" / "run.csv")]
    monkeypatch.chdir(tmp_path / "far")
    recording = read(build(kept, "data", default=Measurements), DECAY, tmp_path / "far", 0)
    assert firsts(recording) == ({"train:0": 100}, {"run:0": 500})
    assert absolute({"path": 3}, tmp_path) == {"path": 3}  # left for the schema to refuse
