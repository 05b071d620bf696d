"""Files of a run: atomic, schema-true, and readable only as what they are."""

import json
import pickle
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import simpel

from simpel_cli.errors import ConfigError
from simpel_cli.runs.arrays import load_checkpoint, save_checkpoint
from simpel_cli.runs.files import replacing, write_table, write_text
from simpel_cli.runs.metrics import MetricStream, read_metrics, write_metrics

CONSTANTS = {
    "run": "r",
    "command": "fit",
    "experiment": "e",
    "method": "simpel",
    "sim": "s",
    "data": "d",
    "n_train": 20,
}


def row(step: int, split: str = "train", value: float = 1.5) -> dict[str, object]:
    return {"seed": 0, "step": step, "split": split, "metric": "loss", "output": "joint", "unit": "nat", "value": value}


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_failed_write_leaves_the_old_file_and_no_rest(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def failing() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            assert path.read_text() == "old"  # not there before it is complete
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        failing()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]
    write_text(path, "new")
    assert path.read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def test_files_are_readable_by_others_as_the_umask_allows(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "x")
    (tmp_path / "b").write_text("x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_schema_is_the_contract(tmp_path: Path) -> None:
    """ARCHITECTURE.md, "A run directory"."""
    contract = (
        "run, command, experiment, method, sim, data, n_train:int32, seed:int32, step:int64, split, metric, output, unit, "
        "value:float64"
    )
    path = write_metrics(tmp_path / "metrics.parquet", [row(3)], CONSTANTS)
    schema = pq.read_schema(path)
    expected = [tuple(entry.split(":")) if ":" in entry else (entry, "string") for entry in contract.split(", ")]
    assert [(f.name, {"double": "float64"}.get(str(f.type), str(f.type))) for f in schema] == expected
    assert pq.read_schema(write_metrics(tmp_path / "empty.parquet", [], CONSTANTS)) == schema
    assert read_metrics(path) == [CONSTANTS | row(3)]


def test_rows_win_over_constants_and_what_is_missing_is_null(tmp_path: Path) -> None:
    path = write_metrics(tmp_path / "m.parquet", [{"metric": "nll", "n_train": 7}], CONSTANTS)
    (read,) = read_metrics(path)
    assert (read["n_train"], read["metric"], read["value"], read["sim"]) == (7, "nll", None, "s")


def test_stream_becomes_parquet(tmp_path: Path) -> None:
    stream = MetricStream(tmp_path, CONSTANTS)
    stream.add([row(10), row(20)])
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 2  # flushed: a kill loses nothing
    stream.add([row(20, "test", float("nan"))])
    read = read_metrics(stream.close())
    assert [r["step"] for r in read] == [10, 20, 20]
    assert np.isnan(read[2]["value"])
    assert names(tmp_path) == ["metrics.parquet"]


def killed(folder: Path, rows: list[dict[str, object]]) -> None:
    stream = MetricStream(folder, CONSTANTS)
    stream.add(rows)
    stream._file.close()  # as the kernel does it; nothing of `close` happens


def test_resumed_stream_is_cut_at_the_checkpoint(tmp_path: Path) -> None:
    killed(tmp_path, [row(10), row(20), row(20, "test"), row(30)])
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 0, "step": 40, "spl')  # killed in the middle of a line
    resumed = MetricStream(tmp_path, CONSTANTS, resume_at=20)
    resumed.add([row(30, value=9.0)])
    read = read_metrics(resumed.close())
    assert [(r["step"], r["split"], r["value"]) for r in read] == [
        (10, "train", 1.5), (20, "train", 1.5), (30, "train", 9.0),
    ]  # fmt: skip


def test_new_stream_forgets_the_old_one(tmp_path: Path) -> None:
    killed(tmp_path, [row(10)])
    assert read_metrics(MetricStream(tmp_path, CONSTANTS).close()) == []


def test_damaged_metrics_are_named(tmp_path: Path) -> None:
    path = tmp_path / "metrics.parquet"
    with pytest.raises(ConfigError, match=r"metrics.parquet: not readable as metrics"):
        read_metrics(path)
    path.write_bytes(b"PAR1 but not really")
    with pytest.raises(ConfigError, match=r"metrics.parquet: not readable as metrics"):
        read_metrics(path)


def test_table(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", {"a": [1, 2], "b": np.array([0.5, 1.5])})
    assert pq.read_table(tmp_path / "t.parquet").to_pydict() == {"a": [1, 2], "b": [0.5, 1.5]}


LEAVES = {
    "w": np.arange(6, dtype=np.float32).reshape(2, 3).T,  # not contiguous
    "count": np.array(7, np.int32),
    "rho": np.array([1e-300, np.pi]),
    "empty": np.zeros((0, 4)),
}


def test_checkpoint_comes_back_as_it_was(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "checkpoint", LEAVES, {"step": 500, "name": "φ"})
    leaves, facts = load_checkpoint(tmp_path / "checkpoint")
    assert facts == {"step": 500, "name": "φ"}
    assert leaves.keys() == LEAVES.keys()
    for name, expected in LEAVES.items():
        assert leaves[name].dtype == expected.dtype
        assert leaves[name].shape == expected.shape
        np.testing.assert_array_equal(leaves[name], expected)


def test_checkpoint_removes_what_a_kill_left(tmp_path: Path) -> None:
    (tmp_path / ".state.safetensors.abc.tmp").touch()
    save_checkpoint(tmp_path, LEAVES, {})
    save_checkpoint(tmp_path, LEAVES, {"step": 2})
    assert names(tmp_path) == ["state.safetensors"]
    assert load_checkpoint(tmp_path)[1] == {"step": 2}


@pytest.mark.parametrize("keep", [0, 4, 40, -1])
def test_truncated_checkpoint_is_refused(tmp_path: Path, keep: int) -> None:
    save_checkpoint(tmp_path, LEAVES, {"step": 500})
    path = tmp_path / "state.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ConfigError, match=r"state.safetensors: damaged or not a checkpoint of simpel .* fit again"):
        load_checkpoint(tmp_path)


def test_a_checkpoint_of_which_any_byte_has_changed_is_refused(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, LEAVES, {"step": 500, "loss": 0.1})
    path = tmp_path / "state.safetensors"
    content = path.read_bytes()
    for i in range(len(content)):
        path.write_bytes(content[:i] + bytes([content[i] ^ 1]) + content[i + 1 :])
        try:
            leaves, facts = load_checkpoint(tmp_path)
        except ConfigError:
            continue
        # what may be otherwise is how a header is written, and the sum's own name
        assert facts.items() >= {"step": 500, "loss": 0.1}.items()
        assert all(np.array_equal(leaves[name], expected) for name, expected in LEAVES.items())


def test_a_checkpoint_of_an_earlier_version_has_no_sum(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    save_file({"w": np.ones(2)}, tmp_path / "state.safetensors", metadata={"simpel": json.dumps({"step": 3})})
    leaves, facts = load_checkpoint(tmp_path)
    assert (leaves["w"].tolist(), facts) == ([1, 1], {"step": 3})


def test_a_table_of_which_a_value_has_changed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "metrics.parquet"
    values = np.random.default_rng(0).normal(size=50)  # nothing to compress
    write_metrics(path, [{"metric": "nll", "value": value} for value in values], {})
    content = path.read_bytes()
    at = content.index(values[20:24].tobytes())
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    with pytest.raises(ConfigError, match=r"metrics.parquet: not readable as metrics"):
        read_metrics(path)


def test_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no checkpoint\. The run stopped before its first one"):
        load_checkpoint(tmp_path)


class Trap:
    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path("trap-sprung"),))


def test_nothing_is_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "state.safetensors").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ConfigError, match="damaged or not a checkpoint"):
        load_checkpoint(tmp_path)
    with (tmp_path / "state.safetensors").open("wb") as file:
        np.save(file, np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(ConfigError, match="damaged or not a checkpoint"):
        load_checkpoint(tmp_path)
    assert not (tmp_path / "trap-sprung").exists()


def test_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    save_file({"w": np.zeros(2)}, tmp_path / "state.safetensors", metadata={"other": json.dumps({})})
    with pytest.raises(ConfigError, match="damaged or not a checkpoint of simpel"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("verb", [("evaluate", "run"), ("export", "run"), ("fit", "--resume", "run")])
def test_a_run_of_another_version_is_refused_with_a_sentence(tmp_path: Path, verb: tuple[str, ...]) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("prior: {_target_: simpel_cli.prior.SimulatorPrior}\n")
    (run / "manifest.json").write_text('{"command": "fit", "status": "done", "versions": {"simpel": "0.0.9"}}')
    result = simpel(tmp_path, *verb)
    assert result.code == 2
    assert (
        "run: made by another version of simpel (0.0.9, run directory format 1; this version reads format 2)"
        in result.err
    )
