"""Files that are complete or absent: written to a temporary name, flushed to disk, renamed."""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


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
    write_parquet(path, table.cast(pa.schema(fields)))


def write_parquet(path: Path, table: Any) -> None:
    """Write an Arrow table atomically, with checksums of its pages."""
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


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Read a Parquet file as arrays by column.

    Raises:
        OSError, pyarrow.ArrowException: it is missing or damaged.
    """
    table = read_table(path)
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}


def read_units(path: Path) -> dict[str, str]:
    """Read the units of columns from the metadata of a Parquet file's fields."""
    import pyarrow.parquet as pq

    schema = pq.read_schema(path)
    return {f.name: f.metadata[b"unit"].decode() for f in schema if f.metadata and b"unit" in f.metadata}
