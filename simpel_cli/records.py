"""Files of a run: metric rows as Parquet with one fixed schema, arrays as safetensors. Writes are atomic.

A file appears under its name only when it is complete (temporary name in the same folder, fsync, rename), so a kill
leaves the old one. Contents carry checksums: a disk or a copy that changed a bit is noticed, where it would else be read as
another number. Nothing that is loaded is ever unpickled.
"""

import contextlib
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.errors import ConfigError
from simpel_cli.tensorboard import Scalars

COLUMNS = (
    ("run", "string"), ("command", "string"), ("experiment", "string"), ("method", "string"), ("sim", "string"),
    ("data", "string"), ("n_train", "int32"), ("seed", "int32"), ("step", "int64"), ("split", "string"),
    ("metric", "string"), ("output", "string"), ("unit", "string"), ("value", "float64"),
)  # fmt: skip


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path; on success it is fsynced and takes the place of `path`, on failure it is removed."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes 0600, which hides runs from a group on a cluster
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def strict(value: Any) -> Any:
    """Return what JSON can hold: null where a number is not finite (RFC 8259, section 6)."""
    if isinstance(value, Mapping):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_table(path: Path, columns: dict[str, Any], units: Mapping[str, str] | None = None) -> None:
    """Write columns (name -> sequence) as Parquet, atomically; units of columns become metadata of their fields."""
    import pyarrow as pa

    table = pa.Table.from_pydict(columns)
    fields = [f.with_metadata({"unit": units[f.name]}) if units and f.name in units else f for f in table.schema]
    _write_parquet(path, table.cast(pa.schema(fields)))


def _write_parquet(path: Path, table: Any) -> None:
    import pyarrow.parquet as pq

    with replacing(path) as temporary:
        pq.write_table(table, temporary, write_page_checksum=True)


def read_table(path: Path) -> Any:
    """Read a Parquet file, of anybody's, as an Arrow table; where its pages have checksums, they are checked.

    Raises:
        OSError, pyarrow.ArrowException: it is missing or damaged.
    """
    import pyarrow.parquet as pq

    return pq.read_table(path, page_checksum_verification=True)


class MetricStream:
    """Append-only stream of metric rows that survives SIGKILL, turned into `metrics.parquet` by `close`.

    Rows go to `metrics.jsonl`, flushed per write. On resume, rows after the checkpoint's step are cut off, and what a
    kill left half-written is dropped.

    Args:
        directory: the run directory.
        constants: values of the columns that are the same in every row of the run.
        resume_at: step of the checkpoint that the run goes on from; None: it begins.
        scalars: takes the rows as well, e.g. `tensorboard.Scalars`.
    """

    def __init__(
        self,
        directory: Path,
        constants: dict[str, Any],
        *,
        resume_at: int | None = None,
        scalars: Scalars | None = None,
    ) -> None:
        self.directory, self.constants, self.scalars = directory, constants, scalars
        self.path = directory / "metrics.jsonl"
        kept = (
            [] if resume_at is None else [r for r in self._read() if r["split"] == "train" and r["step"] <= resume_at]
        )
        write_text(self.path, "".join(json.dumps(r) + "\n" for r in kept))
        self._file = self.path.open("a")

    def __enter__(self) -> "MetricStream":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()  # the stream stays, so that the run can go on
        if self.scalars is not None:
            self.scalars.close()

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Append rows: any of seed, step, split, metric, output, unit, value."""
        rows = list(rows)
        for row in rows:
            self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        if self.scalars is not None:
            self.scalars.add(rows)

    def close(self) -> Path:
        """Write `metrics.parquet` from the stream and remove the stream."""
        self._file.close()
        path = write_metrics(self.directory / "metrics.parquet", self._read(), self.constants)
        self.path.unlink()
        return path

    def _read(self) -> list[dict[str, Any]]:
        rows = []
        table = self.directory / "metrics.parquet"
        if not self.path.exists() and table.exists():  # stopped after `close`, while figures were drawn
            return read_metrics(table)
        with contextlib.suppress(FileNotFoundError):
            for line in self.path.read_text().splitlines():
                with contextlib.suppress(json.JSONDecodeError):  # the last line of a killed run may be half-written
                    rows.append(json.loads(line))
        return rows


def write_metrics(path: Path, rows: list[dict[str, Any]], constants: dict[str, Any]) -> Path:
    """Write metric rows as tidy Parquet with the fixed schema of every verb."""
    import pyarrow as pa

    types = {"string": pa.string(), "int32": pa.int32(), "int64": pa.int64(), "float64": pa.float64()}
    schema = pa.schema([(name, types[kind]) for name, kind in COLUMNS])
    table = pa.table({n: pa.array([(constants | r).get(n) for r in rows], types[k]) for n, k in COLUMNS}, schema=schema)
    _write_parquet(path, table)
    return path


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read metric rows.

    Raises:
        ConfigError: the file is missing or damaged.
    """
    import pyarrow as pa

    try:
        return read_table(path).to_pylist()
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not readable as metrics ({str(error).splitlines()[0]}).") from error


def save_checkpoint(directory: Path, leaves: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    """Write `state.safetensors` and the JSON facts inside its header, as one atomic file."""
    directory.mkdir(exist_ok=True)
    for stale in directory.glob(".*.tmp"):  # what a kill left of an earlier write
        stale.unlink(missing_ok=True)
    write_arrays(directory / "state.safetensors", leaves, facts)


def load_checkpoint(directory: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a checkpoint's arrays and facts.

    Raises:
        ConfigError: missing, truncated or not a checkpoint of simpel.
    """
    path = directory / "state.safetensors"
    if not path.is_file():
        raise ConfigError(f"{path}: no checkpoint. The run stopped before its first one; start it again.")
    try:
        arrays, facts = read_arrays(path)
        if not facts:
            raise ValueError("it has no facts of a run")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: damaged or not a checkpoint of simpel ({error}). Restore it or fit again."
        ) from error
    return arrays, facts


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write arrays as safetensors, atomically, with JSON facts and the SHA-256 of both in the header."""
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    contiguous = {name: np.asarray(a, order="C") for name, a in arrays.items()}
    # under one key: safetensors writes several in any order, and the same results are to be the same bytes
    header = {"simpel": json.dumps({**facts, "sha256": _digest(contiguous, facts)})}
    with replacing(path) as temporary:
        try:
            save_file(contiguous, temporary, metadata=header)
        except SafetensorError as error:
            if found := re.search(r"os error (\d+)", str(error)):  # of the disk, not of what is written
                raise OSError(int(found[1]), os.strerror(int(found[1])), str(path.parent)) from error
            raise


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays and facts of `write_arrays`.

    Raises:
        OSError: it cannot be opened.
        ValueError: cut off, or changed since it was written.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            facts = json.loads((file.metadata() or {}).get("simpel", "{}"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            known = facts.pop("sha256", None)  # none in files of earlier versions
    except (SafetensorError, AttributeError, TypeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if known is not None and known != _digest(arrays, facts):
        raise ValueError("it is not what was written: the SHA-256 differs")
    return arrays, facts


def _digest(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> str:
    """Return the SHA-256 of facts, and of every array's name, type, shape and values."""
    digest = hashlib.sha256(json.dumps(facts).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
