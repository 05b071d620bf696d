"""A Parquet or CSV file as named columns, with messages that a person can act on."""

import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from simpel_cli.data.tables.csv_file import BLANKS, Dialect, line_of, read_csv
from simpel_cli.errors import DataError

DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


@dataclass(frozen=True)
class Sheet:
    """Columns of a file; a column is converted when it is asked for, so text in an unused one does no harm.

    Args:
        path: the file.
        columns: name -> Arrow column, all of the same length.
        units: name -> unit, from Parquet field metadata.
        dialect: of a CSV file.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray]
    units: dict[str, str] = field(default_factory=dict)
    dialect: Dialect = Dialect()

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def numbers(self, name: str) -> np.ndarray:
        """Column as float64, shape (n,); a missing entry is NaN, a time stamp becomes s since the first one.

        Raises:
            DataError: text in the column; the message names column, place and text.
        """
        column = self.columns[name]
        if pa.types.is_timestamp(column.type):
            column = _seconds(column)
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            # numbers with blanks around them are common in hand-made files and are no fault
            column = pc.utf8_trim_whitespace(column)
        try:
            numbers = pc.cast(column, pa.float64(), safe=False)
        except pa.ArrowException as error:
            raise self._not_a_number(name, column) from error
        return numbers.to_numpy(zero_copy_only=False).astype(np.float64)

    def labels(self, name: str) -> np.ndarray:
        """Column as text, shape (n,); whole numbers without a decimal point, a missing entry is empty."""
        column = self.columns[name]
        if pa.types.is_floating(column.type):
            with suppress(pa.ArrowException):
                column = pc.cast(column, pa.int64())
        if pa.types.is_nested(column.type):
            raise DataError(f"column '{name}' of {self.path.name} holds {column.type}, not names or numbers.")
        texts = pc.fill_null(pc.cast(column, pa.string()), "")
        return np.array(pc.utf8_trim_whitespace(texts).to_pylist(), dtype=str)

    def place(self, index: int) -> str:
        """Name a row as a person finds it: the line of a CSV file, the row of a Parquet file counted from 0."""
        if self.path.suffix.lower() != ".csv":
            return f"row {index} (counted from 0)"
        return f"line {line_of(self.path, self.dialect, index)}"

    def _not_a_number(self, name: str, column: pa.ChunkedArray) -> DataError:
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            return DataError(f"column '{name}' of {self.path.name} holds {column.type}, not numbers.")
        index, text = next((i, t) for i, t in enumerate(column.to_pylist()) if t is not None and not _is_number(t))
        cure = "Write numbers with a decimal point, and leave a missing one empty."
        if DECIMAL_COMMA.fullmatch(text):
            cure = f"It looks like a decimal comma: write {text.replace(',', '.')}."
            if self.dialect.separator != ",":
                separator = r"\s+" if self.dialect.separator == BLANKS else self.dialect.separator
                cure += (
                    f" All at once: pandas.read_csv('{self.path.name}', sep={separator!r}, decimal=',')"
                    f".to_csv(..., index=False)"
                )
        return DataError(
            f"column '{name}' of {self.path.name} should hold numbers, but {self.place(index)} has {text[:40]!r}. "
            f"{cure}"
        )


def read_sheet(path: Path) -> Sheet:
    """Read a .parquet or .csv file.

    Raises:
        DataError: the extension is neither, or the file is empty, damaged, has no rows, repeats a name or is written
            in another CSV dialect.
    """
    readers = {".parquet": _read_parquet, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise DataError(f"data.path: {path.name} ends in '{path.suffix}', only .parquet or .csv can be read.")
    if path.stat().st_size == 0:
        raise DataError(f"{path.name} is empty (0 bytes).")
    sheet = readers[path.suffix.lower()](path)
    if not sheet.columns:
        raise DataError(f"{path.name} has no named columns.")
    if len(sheet) == 0:
        raise DataError(f"{path.name} has a header ({', '.join(sheet.columns)}) but no rows.")
    return sheet


def _read_parquet(path: Path) -> Sheet:
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            content = file.read()
        content.validate(full=True)  # of texts, that they are some
        names = content.column_names
        units = {f.name: f.metadata[b"unit"].decode() for f in content.schema if f.metadata and b"unit" in f.metadata}
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path.name} is damaged, cut off or no Parquet file. Copy or write it again.") from error
    _refuse_repeated(path, names)
    return Sheet(path, {name: _plain(content[name]) for name in content.column_names}, units)


def _read_csv(path: Path) -> Sheet:
    columns, dialect = read_csv(path)
    return Sheet(path, columns, dialect=dialect)


def _refuse_repeated(path: Path, names: list[str]) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise DataError(f"{path.name} has more than one column named {', '.join(repeated)}. Give each its own name.")


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Undo dictionary encoding, which pandas writes for categories."""
    return pc.cast(column, column.type.value_type) if pa.types.is_dictionary(column.type) else column


def _seconds(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Time stamps as s since the earliest; the difference is taken in whole ns, where float64 would lose digits."""
    stamps = pc.cast(pc.cast(column, pa.timestamp("ns", tz=column.type.tz)), pa.int64())
    return pc.multiply(pc.cast(pc.subtract(stamps, pc.min(stamps)), pa.float64()), 1e-9)


def _is_number(text: str) -> bool:
    try:
        pc.cast(pa.scalar(text), pa.float64())
    except pa.ArrowException:
        return False
    return True
