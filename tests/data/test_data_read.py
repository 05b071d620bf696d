"""Reading files: what comes out, and the message for everything that can be wrong with a file or its YAML."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from simpel_cli.data import Measurements, Recording, read, transitions
from simpel_cli.data.tables.read_file import read_sheet
from simpel_cli.errors import ConfigError, DataError, SimpelError
from simulators.model import Declared, Model

CONF = Path(__file__).parents[2] / "conf"
CART = Declared(
    name="cart",
    dt=0.1,
    states={"s": {"unit": "m", "range": [-10, 10]}, "v": {"unit": "m/s", "range": [-5, 5]}},
    inputs={"u": {"unit": "V", "range": [-2, 2]}},
    parameters={"k": {"unit": "1/s", "range": [0.5, 1.5]}},
    dynamics={"s": "v", "v": "u - k*v"},
    outputs={"force": {"unit": "N", "expression": "k*v"}},
).model()

NASTY = [
    b"#",
    b"\t",
    b" ",
    b"\n#",
    b",",
    b"\n",
    b"\r",
    b'"',
    b";",
    b"\x00",
    b"e",
    b"-",
    b"9" * 400,
    b"nan",
    b"inf",
    b"1e308",
    b"\n\n",
]


def csv_text(episodes: int = 4, rows: int = 12) -> str:
    lines = ["run, t, s, v, volts"]
    for run in range(episodes):
        for i in range(rows):
            t = 0.1 * i
            lines.append(f"{run},{t:.3f},{np.sin(t + run):.9f},{np.cos(t + run):.9f},{(i % 3) - 1}")
    return "\n".join(lines) + "\n"


def read_text(folder: Path, text: str, model: Model = CART, name: str = "run.csv", **keys: Any) -> Recording:
    (folder / name).write_text(text, encoding="utf-8")
    defaults: dict[str, Any] = {"time": "t", "episode": "run", "columns": {"u": "volts"}}
    return read(Measurements(path=name, **(defaults | keys)), model, folder, 0)


def test_csv_values_and_episodes(tmp_path: Path) -> None:
    recording = read_text(tmp_path, csv_text())
    assert (len(recording.train), len(recording.test)) == (3, 1)
    assert recording.outputs == ()
    assert recording.files == (tmp_path / "run.csv",)
    for episode in (*recording.train, *recording.test):
        t = 0.1 * np.arange(12)
        expected = np.stack([np.sin(t + int(episode.name)), np.cos(t + int(episode.name))], axis=1)
        np.testing.assert_allclose(episode.states, expected, atol=1e-8)
        np.testing.assert_array_equal(episode.inputs[:, 0], (np.arange(12) % 3) - 1)


DIALECTS = {
    "semicolons": lambda text: text.replace(",", ";"),
    "tabs": lambda text: text.replace(",", "\t"),
    "blanks": lambda text: text.replace(", ", " ").replace(",", "   "),
    "indented": lambda text: "".join(f"  {line}\n" for line in text.replace(", ", " ").replace(",", " ").splitlines()),
    "windows": lambda text: text.replace("\n", "\r\n"),
    "byte order mark": lambda text: "\ufeff" + text,
    "remarks": lambda text: "# cart, first try\n#\n" + text.replace("\n1,0.500", "\n  # here it hit the wall; again\n1,0.500"),
    "names in a remark": lambda text: "# cart\n# " + text,
    "numpy": lambda text: "# " + text.replace(", ", " ").replace(",", " "),
    "names by commas, rows by blanks": lambda text: "# " + text[:18] + text[18:].replace(",", " "),
    "semicolons and remarks": lambda text: "# a;b\n" + text.replace(",", ";"),
}  # fmt: skip


@pytest.mark.parametrize("dialect", DIALECTS)
def test_other_ways_to_write_a_csv_file(tmp_path: Path, dialect: str) -> None:
    (tmp_path / "run.csv").write_bytes(DIALECTS[dialect](csv_text()).encode())
    config = Measurements("run.csv", time="t", episode="run", columns={"u": "volts"})
    found, plain = read(config, CART, tmp_path, 0), read_text(tmp_path, csv_text(), name="plain.csv")
    for a, b in zip((*found.train, *found.test), (*plain.train, *plain.test), strict=True):
        np.testing.assert_array_equal(a.states, b.states)
        np.testing.assert_array_equal(a.inputs, b.inputs)
        assert a.name == b.name


def test_parquet_reads_the_same_and_measures_an_output(tmp_path: Path) -> None:
    t = np.tile(0.1 * np.arange(12), 4)
    run = np.repeat([0, 1, 2, 3], 12)
    columns = {"run": run, "t": t, "s": np.sin(t + run), "v": np.cos(t + run), "volts": np.sin(9 * t), "force": t}
    parquet.write_table(pa.table(columns), tmp_path / "run.parquet")
    config = Measurements("run.parquet", time="t", episode="run", columns={"u": "volts"})
    recording = read(config, CART, tmp_path, 0)
    assert recording.outputs == ("force",)
    np.testing.assert_allclose(recording.train[0].outputs[:, 0], 0.1 * np.arange(12))


def test_transitions_pair_rows_and_stack_inputs_oldest_first(tmp_path: Path) -> None:
    train = read_text(tmp_path, csv_text(), stack_actions=2).train
    pairs = transitions(train, 2)
    assert len(pairs.row) == 3 * (12 - 1 - 2)
    for k, (e, i) in enumerate(zip(pairs.episode, pairs.row, strict=True)):
        np.testing.assert_array_equal(pairs.states[k], train[e].states[i])
        np.testing.assert_array_equal(pairs.next_states[k], train[e].states[i + 1])
        np.testing.assert_array_equal(pairs.inputs[k], train[e].inputs[i - 2 : i + 1, 0])


def test_interleaved_episodes_are_put_in_order(tmp_path: Path) -> None:
    header, *lines = csv_text().splitlines()
    by_time = sorted(lines, key=lambda line: float(line.split(",")[1]))
    mixed = read_text(tmp_path, "\n".join([header, *by_time]))
    plain = read_text(tmp_path, csv_text(), name="plain.csv")
    for a, b in zip(mixed.train, plain.train, strict=True):
        np.testing.assert_array_equal(a.states, b.states)


def test_layout_transitions(tmp_path: Path) -> None:
    rows = [f"{i},{-i},1,{i + 0.5},{-i - 0.5}" for i in range(20)]
    text = "\n".join(["s,v,u,next_s,next_v", *rows])
    recording = read_text(tmp_path, text, layout="transitions", time=None, episode=None, columns={})
    pairs = transitions(recording.train, 0)
    assert (len(pairs.row), len(transitions(recording.test, 0).row)) == (15, 5)
    np.testing.assert_allclose(pairs.next_states - pairs.states, np.tile([0.5, -0.5], (15, 1)))


def test_layout_transitions_takes_the_nearest_turn(tmp_path: Path) -> None:
    model = Declared(
        name="wheel", dt=0.1, states={"a": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}}, dynamics={"a": "1"}
    ).model()
    text = "a,next_a\n" + "3.1,-3.1\n-3.1,3.1\n0.1,0.2\n" * 4
    recording = read_text(tmp_path, text, model, layout="transitions", time=None, episode=None, columns={})
    pairs = transitions(recording.train, 0)
    assert np.max(np.abs(pairs.next_states - pairs.states)) < 0.11


def test_static_model_takes_every_row(tmp_path: Path) -> None:
    model = Declared(name="line", dt=1, inputs={"x": {"range": [0, 9]}}, outputs={"y": "2*x"}).model()
    text = "x,y\n" + "".join(f"{i},{2 * i}\n" for i in range(8))
    recording = read_text(tmp_path, text, model, time=None, episode=None, columns={}, split={"by": "time"})
    pairs = transitions(recording.train, 0)
    assert pairs.states.shape == (6, 0)
    np.testing.assert_array_equal(pairs.outputs, 2 * pairs.inputs)


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("", ["run.csv is empty"]),
        ("run,t,s,v,volts\n", ["has a header (run, t, s, v, volts) but no rows"]),
        (
            "run;t;s;v;volts\n0;0,1;1,2;3.4;5,6\n",
            ["line 2 has '0,1'", "Other numbers of the file have a decimal point"],
        ),
        (
            "run;t;s;v;volts\n0;0;1,234;3;5\n",
            ["may be 1.234 or 1234", "read_csv('run.csv', sep=';', decimal=',')", "the same with thousands=','"],
        ),
        ("run t s v volts\n0 0 1,234 3 5\n", ["line 2 has '1,234'", "sep='\\\\s+', decimal=','"]),
        (
            "run;t;s;v;volts\n0;0,1;1.234,5;3;5\n",
            ["line 2 has '1.234,5'", "decimal comma, without separators of thousands"],
        ),
        ("0,5;1,5\n0;1\n", ["run.csv starts with numbers"]),
        ("run,t,s;v,volts\n0,0,1;1,0\n", ["read in two ways", "a comma (4 columns) or a semicolon (2 columns)"]),
        (
            "run t [s] s v volts\n0 0.1 1 1 0\n",
            ["its 5 columns by blanks", "header has 6 words", "names without blanks"],
        ),
        ("# made by hand\n# nothing else\n", ["run.csv has comment lines (#) only"]),
        ("# no names\n0,0,1,1,0\n", ["run.csv starts with numbers"]),
        ("run,t,s,v,volts\n# a remark\n0,0,1,1,0\n\n0,0.1,oops,1,0\n", ["column 's'", "line 5", "'oops'"]),
        (
            "# remark\nrun,t,s,v,volts\n0,0,1,1\n",
            ["5 columns, but record 2", "comments are not counted", "has 4: '0,0,1,1'"],
        ),
        ("run,t,s,v,volts\n0,0,0,1,0,5,6\n", ["record 2", "decimal comma"]),
        ('run,t,s,v,volts\n0,0,"0,5",1,0\n', ["column 's'", "decimal comma", "0.5"]),
        ("run,t,s,s,volts\n0,0,1,1,0\n", ["more than one column named s"]),
        ("run,t,s,v,volts\n0,0,1,1,0\n\n0,0.1,oops,1,0\n", ["column 's'", "line 4", "'oops'"]),
        ("0,0.1,0.2,0.3,0.4\n0,0,1,1,0\n", ["first line must name the columns"]),
        ("run,t,s,volts\n0,0,1,1\n", ["column 'v' is missing in run.csv (it has: run, t, s, volts)", "{v: null}"]),
        ("run,t,s,v,volt\n0,0,1,1,1\n", ["column 'volts' is missing", "Did you mean volt?", "{u: <name>}"]),
        ("run,time,s,v,volts\n0,0,1,1,1\n", ["column 't' is missing", "data.time"]),
        ("runs,t,s,v,volts\n0,0,1,1,1\n", ["column 'run' is missing", "Did you mean runs?", "data.episode"]),
    ],
)
def test_faults_of_a_csv_file(tmp_path: Path, text: str, fragments: list[str]) -> None:
    with pytest.raises(DataError) as error:
        read_text(tmp_path, text)
    assert error.value.exit_code == 3
    for fragment in fragments:
        assert fragment in str(error.value)


def test_file_is_missing_or_of_another_kind(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"'nowhere\.csv' was not found") as error:
        read(Measurements("nowhere.csv"), CART, tmp_path, 0)
    assert str(tmp_path) in str(error.value)
    assert str(Path.cwd()) in str(error.value)
    (tmp_path / "run.xlsx").write_text("x")
    with pytest.raises(DataError, match=r"'.xlsx', only .parquet, .csv, "):
        read(Measurements("run.xlsx"), CART, tmp_path, 0)


def test_cut_off_parquet_gets_a_short_message(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"s": np.arange(1000.0)}), tmp_path / "whole.parquet")
    (tmp_path / "half.parquet").write_bytes((tmp_path / "whole.parquet").read_bytes()[:2000])
    with pytest.raises(DataError, match=r"half\.parquet is damaged, cut off") as error:
        read(Measurements("half.parquet"), CART, tmp_path, 0)
    assert len(str(error.value)) < 120


def test_a_parquet_file_with_any_byte_changed_is_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.parquet"
    table = pa.table({"größe": ["ä", "b", "ä"], "pos": [0.1, 0.2, 0.3]})
    unit = table.schema.field("pos").with_metadata({"unit": "°"})
    parquet.write_table(table.cast(pa.schema([table.schema.field(0), unit])), path)
    content = path.read_bytes()
    for i in range(len(content)):
        path.write_bytes(content[:i] + bytes([content[i] ^ 0xFF]) + content[i + 1 :])
        with contextlib.suppress(DataError):
            sheet = read_sheet(path)
            for name in sheet.columns:
                with contextlib.suppress(DataError):
                    sheet.labels(name)
                    sheet.numbers(name)


def test_latin1_is_named(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes("t,s,v,\xfcber\n0,1,1,1\n".encode("latin-1"))
    with pytest.raises(DataError, match="UTF-8"):
        read(Measurements("run.csv"), CART, tmp_path, 0)


@pytest.mark.parametrize(
    ("keys", "fragment"),
    [
        ({"layout": "trajectory"}, "data.layout: 'trajectory' is not allowed.*Did you mean trajectories"),
        ({"choice": "best"}, "data.choice"),
        ({"n_train": -1}, "data.n_train: -1"),
        ({"resample": -1.0}, "data.resample: -1.0"),
        ({"resample": 0.1}, "data.resample.*data.time"),
        ({"noise_std": {"phi": 0}}, "data.noise_std.phi: 0"),
        ({"split": {"test_fractoin": 0.2}}, "data.split.test_fractoin.*Did you mean test_fraction"),
        ({"split": {"test_fraction": 1.5}}, "data.split.test_fraction: 1.5"),
        ({"split": {"by": "rows"}}, "data.split.by: 'rows'"),
        ({"layout": "transitions", "stack_actions": 2}, "data.stack_actions: 2"),
    ],
)
def test_values_of_the_yaml(keys: dict[str, Any], fragment: str) -> None:
    with pytest.raises(ConfigError, match=fragment) as error:
        Measurements("run.csv", **keys)
    assert error.value.exit_code == 2


def test_keys_must_be_quantities_of_the_simulator(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.columns.force_: .*it has: s, v, force, u.*Did you mean force\?"):
        read_text(tmp_path, csv_text(), columns={"u": "volts", "force_": "F"})
    with pytest.raises(DataError, match=r"data\.columns\.u: an input cannot be estimated"):
        read_text(tmp_path, csv_text(), columns={"u": None})


def test_mutated_csv_gives_a_recording_or_our_error(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("mutated")
    original = csv_text(episodes=3, rows=6).encode()
    outcomes = set()

    @settings(max_examples=100, deadline=None, database=None)
    @given(
        edits=st.lists(
            st.tuples(
                st.integers(0, len(original) - 1),
                st.integers(0, 3),
                st.one_of(st.sampled_from(NASTY), st.binary()),
            ),
            min_size=1,
            max_size=6,
        )
    )
    def mutate(edits: list[tuple[int, int, bytes]]) -> None:
        content = original
        for at, removed, inserted in edits:
            content = content[:at] + inserted + content[at + removed :]
        (folder / "run.csv").write_bytes(content)
        try:
            read(Measurements("run.csv", time="t", episode="run", columns={"u": "volts"}), CART, folder, 0)
        except SimpelError as error:
            outcomes.add(error.exit_code)
        else:
            outcomes.add(0)

    mutate()
    assert outcomes <= {0, 2, 3}
    assert 3 in outcomes


@pytest.mark.parametrize("columns", [{"phi": "a", "omega": "w"}, {"phi": "a", "omega": None}])
def test_shipped_free_pendulum_fits_its_simulator(tmp_path: Path, columns: dict[str, str | None]) -> None:
    def fields(path: str) -> dict[str, Any]:
        return {k: v for k, v in yaml.safe_load((CONF / path).read_text()).items() if k != "_target_"}

    model = Declared(**fields("sim/free_pendulum.yaml")).model()
    t = np.arange(3000) * 1e-3
    swing = {"t": t, "a": np.sin(8 * t), "w": 8 * np.cos(8 * t)}
    table = {name: np.tile(column, 2) for name, column in swing.items()}
    table |= {"episode": np.repeat([0, 1], 3000), "split": np.repeat(["train", "test"], 3000)}
    parquet.write_table(pa.table(table), tmp_path / "swing.parquet")
    config = Measurements(**(fields("data/free_pendulum.yaml") | {"path": "swing.parquet", "columns": columns}))
    episode = read(config, model, tmp_path, 0).train[0]
    np.testing.assert_allclose(np.diff(episode.time), model.dt)
    np.testing.assert_allclose(episode.states[:, 0], np.sin(8 * episode.time), atol=5e-3)
    np.testing.assert_allclose(episode.states[:, 1], 8 * np.cos(8 * episode.time), atol=4e-2)
