"""`metrics.parquet`: one tidy table with one schema for all verbs, and the stream that becomes it."""

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError
from simpel_cli.runs.files import read_table, write_parquet, write_text
from simpel_cli.runs.tensorboard import Scalars

COLUMNS = (
    ("run", "string"), ("command", "string"), ("experiment", "string"), ("method", "string"), ("sim", "string"),
    ("data", "string"), ("n_train", "int32"), ("seed", "int32"), ("step", "int64"), ("split", "string"),
    ("metric", "string"), ("output", "string"), ("unit", "string"), ("value", "float64"),
)  # fmt: skip


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
    write_parquet(path, table)
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
