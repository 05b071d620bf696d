"""A Parquet file as columns, with the units of its field metadata."""

from collections import Counter
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError


def read_parquet(path: Path) -> Sheet:
    """Read a Parquet file.

    Raises:
        DataError: it is damaged, or has two columns of one name.
    """
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            content = file.read()
        content.validate(full=True)  # of texts, that they are some
        names = content.column_names
        units = {f.name: f.metadata[b"unit"].decode() for f in content.schema if f.metadata and b"unit" in f.metadata}
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path.name} is damaged, cut off or no Parquet file. Copy or write it again.") from error
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise DataError(f"{path.name} has more than one column named {', '.join(repeated)}. Give each its own name.")
    return Sheet(path, {name: _plain(content[name]) for name in content.column_names}, units)


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Undo dictionary encoding, which pandas writes for categories."""
    return pc.cast(column, column.type.value_type) if pa.types.is_dictionary(column.type) else column
