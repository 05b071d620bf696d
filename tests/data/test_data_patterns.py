"""A pattern for the files of `data.path`: order, columns from names, splits, kept configurations, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simpel_cli.config.build import build
from simpel_cli.data import Measurements, Recording, absolute, read
from simpel_cli.data.tables.locate import locate
from simpel_cli.data.tables.pattern import matches, natural
from simpel_cli.errors import ConfigError, DataError, SimpelError
from simulators.model import Declared

DECAY = Declared(
    name="decay",
    dt=1.0,
    states={"x": {"unit": "m", "range": [0, 1000]}},
    inputs={"mass": {"unit": "kg", "range": [0, 10]}},
    dynamics={"x": "-x"},
).model()
RIG = ("runs/a/mass1.5_up.csv", "runs/a/mass2_down.csv", "runs/b/mass2_up.csv", "runs/b/mass10_up.csv")


def write(folder: Path, name: str, first: float, head: str = "t,x") -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("\n".join([head, *(f"{i},{first + i}" for i in range(6))]))


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    for i, name in enumerate(RIG):
        write(tmp_path, name, 100 * i)
    return tmp_path


def read_files(folder: Path, path: Any, **keys: Any) -> Recording:
    return read(Measurements(path, **({"time": "t"} | keys)), DECAY, folder, 0)


def masses(recording: Recording) -> dict[str, float]:
    return {e.name: float(e.inputs[0, 0]) for e in (*recording.train, *recording.test)}


def found(folder: Path, pattern: str) -> list[str]:
    return [str(f.path.relative_to(folder)) for f in matches(folder / pattern)]


def test_a_number_in_the_name_is_an_input(rig: Path) -> None:
    recording = read_files(rig, "runs/*/mass{mass}_*.csv")
    assert masses(recording) == {"mass1.5_up": 1.5, "mass2_down": 2, "mass2_up": 2, "mass10_up": 10}
    assert recording.files == tuple(rig / name for name in RIG)
    assert len(recording.test) == 1


def test_text_in_the_name_is_a_split_or_an_episode(rig: Path) -> None:
    keys = {"columns": {"mass": "kg"}, "split": {"column": "part"}}
    for old, new in (("up", "train"), ("down", "test")):
        for path in rig.glob(f"runs/*/*_{old}.csv"):
            path.rename(path.with_stem(path.stem.replace(old, new)))
    recording = read_files(rig, "runs/{day}/mass{kg}_{part}.csv", **keys)
    assert [e.name for e in recording.test] == ["mass2_test"]
    by_day = read_files(
        rig,
        "runs/{day}/mass{kg}_*.csv",
        episode="day",
        columns={"mass": "kg"},
        split={"by": "time", "test_fraction": 0.5},
    )
    assert [e.name.partition(":")[2] for e in by_day.train] == ["a", "a", "b", "b"]  # one episode per file, in any case


def test_one_text_makes_the_column_text(rig: Path) -> None:
    write(rig, "runs/b/massive_up.csv", 0)
    with pytest.raises(DataError, match=r"column 'mass' of massive_up\.csv should hold numbers, but line 2 has 'ive'"):
        read_files(rig, "runs/*/mass{mass}_*.csv")


def test_names_are_sorted_as_people_do(tmp_path: Path) -> None:
    for name in ("run10.csv", "run2.csv", "run1.csv", "deep/er/run3.csv", ".run4.csv", "card.yaml", "run5.txt"):
        write(tmp_path, name, 0)
    assert found(tmp_path, "*.csv") == ["run1.csv", "run2.csv", "run10.csv"]
    assert found(tmp_path, "run?.csv") == ["run1.csv", "run2.csv"]
    assert found(tmp_path, "**/run*.csv") == ["deep/er/run3.csv", "run1.csv", "run2.csv", "run10.csv"]
    assert found(tmp_path, "*/*/run*") == ["deep/er/run3.csv"]
    assert found(tmp_path, "deep/**") == ["deep/er/run3.csv"]
    assert found(tmp_path, "*") == ["run1.csv", "run2.csv", "run5.txt", "run10.csv"]
    assert sorted(["b2", "b10", "2", "b", "10"], key=natural) == ["2", "10", "b", "b2", "b10"]


def test_text_up_to_what_follows(tmp_path: Path) -> None:
    write(tmp_path, "m1_a_b.csv", 0)
    assert [f.named for f in matches(tmp_path / "m{m}_*.csv")] == [{"m": "1"}]
    assert [f.named for f in matches(tmp_path / "{what}_b.csv")] == [{"what": "m1_a"}]
    assert [f.named for f in matches(tmp_path / "{all}")] == [{"all": "m1_a_b.csv"}]


def test_a_pattern_beside_a_file_and_a_file_whose_name_looks_like_one(rig: Path) -> None:
    write(rig, "what?.csv", 500, head="t,x")
    write(rig, "whats.csv", 600)
    assert [f.path.name for f in locate("what?.csv", rig)] == ["what?.csv"]
    recording = read_files(rig, ("runs/a/*.csv", "whats.csv"), columns={"mass": "x"})
    assert {e.name for e in (*recording.train, *recording.test)} == {"mass1.5_up", "mass2_down", "whats"}
    with pytest.raises(DataError, match=r"mass1\.5_up\.csv is named twice"):
        read_files(rig, ("runs/a/*.csv", "runs/**/mass1.5_up.csv"))


def test_files_for_the_test_by_name_and_by_pattern(rig: Path) -> None:
    pattern = "runs/*/mass{mass}_*.csv"
    one = read_files(rig, pattern, split={"test_files": ["b/mass2_up.csv"]})
    assert [e.name for e in one.test] == ["mass2_up"]
    several = read_files(rig, pattern, split={"test_files": ["b/*.csv"]})
    assert [e.name for e in several.test] == ["mass2_up", "mass10_up"]
    with pytest.raises(ConfigError, match=r"test_files: 'c/\*\.csv' is none of the files"):
        read_files(rig, pattern, split={"test_files": ["c/*.csv"]})


def test_a_kept_configuration_finds_its_files_from_anywhere(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (rig / "my").mkdir()
    node = {"path": "../runs/*/mass{mass}_*.csv", "time": "t", "split": {"test_files": ["mass10_up.csv"]}}
    kept = absolute(node, rig / "my")
    assert kept["path"] == str(rig / "runs/*/mass{mass}_*.csv")
    monkeypatch.chdir(rig / "runs")
    recording = read(build(kept, "data", default=Measurements), DECAY, rig / "runs", 0)
    assert [e.name for e in recording.test] == ["mass10_up"]
    assert absolute({"path": ["no/*.csv"]}, rig) == {"path": ["no/*.csv"]}


@pytest.mark.parametrize(
    ("pattern", "kind", "message"),
    [
        ("runs/*/mas{mass}.CSV", DataError, r"no file matches 'runs/\*/mas\{mass\}\.CSV'\. Looked in: .*runs \(nearest there: "
         r"[ab]/mass\w+\.csv, .*\* stands for"),
        ("rums/*.csv", DataError, r"no file matches 'rums/\*\.csv'.*nearest there: runs/[ab]/mass"),
        ("runs/*/mass{mass}_{mass}.csv", ConfigError, r"\{mass\} in .* is there twice"),
        ("runs/*/mass{1}_*.csv", ConfigError, r"\{1\} in .* is no name"),
        ("runs/*/mass{}_*.csv", ConfigError, r"\{\} in .* is no name"),
        ("runs/*/{a}{b}.csv", ConfigError, r"nothing stands between \{a\} and \{b\}"),
        ("runs/*/{a}*.csv", ConfigError, r"nothing stands between \{a\} and \*"),
        ("runs/*/mass{a.csv", ConfigError, r"has a single \{"),
        ("runs/*/mass{x}_*.csv", DataError, r"\{x\} makes a column 'x', but mass1\.5_up\.csv has one already"),
        (("runs/a/mass{mass}_*.csv", "runs/b/*.csv"), DataError, r"column 'mass' is missing in mass2_up\.csv"),
        ("runs", DataError, r"It is a folder, not a file: for the files in it write 'runs/\*\.csv'"),
    ],
)  # fmt: skip
def test_patterns_that_are_refused(rig: Path, pattern: Any, kind: type[SimpelError], message: str) -> None:
    with pytest.raises(kind, match=message):
        read_files(rig, pattern)


def test_files_with_other_columns(rig: Path) -> None:
    write(rig, "runs/b/mass3_up.csv", 0, head="t,y")
    with pytest.raises(DataError, match=r"column 'y' is missing in mass1\.5_up\.csv"):
        read_files(rig, "runs/*/mass{mass}_*.csv")


def test_every_row_knows_the_name_of_its_file(rig: Path) -> None:
    recording = read_files(rig, "runs/*/mass{mass}_*.csv")
    for episode in (*recording.train, *recording.test):
        np.testing.assert_array_equal(episode.inputs, episode.inputs[0, 0])
        assert len(episode.time) == 6
