"""A Parquet or CSV file as named columns, with messages that a person can act on."""

import csv
import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv
from pyarrow import parquet

from simpel_cli.errors import DataError

DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


@dataclass(frozen=True)
class Sheet:
    """Columns of a file; a column is converted when it is asked for, so text in an unused one does no harm.

    Args:
        path: the file.
        columns: name -> Arrow column, all of the same length.
        units: name -> unit, from Parquet field metadata.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray]
    units: dict[str, str] = field(default_factory=dict)

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
        line = index + 2
        with suppress(csv.Error), self.path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            reader = csv.reader(file)
            filled = (reader.line_num for record in reader if record)
            line = next((number for i, number in enumerate(filled) if i == index + 1), line)
        return f"line {line}"

    def _not_a_number(self, name: str, column: pa.ChunkedArray) -> DataError:
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            return DataError(f"column '{name}' of {self.path.name} holds {column.type}, not numbers.")
        index, text = next((i, t) for i, t in enumerate(column.to_pylist()) if t is not None and not _is_number(t))
        cure = "Write numbers with a decimal point, and leave a missing one empty."
        if DECIMAL_COMMA.fullmatch(text):
            cure = f"It looks like a decimal comma: write {text.replace(',', '.')}."
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
        with parquet.ParquetFile(path) as file:
            content = file.read()
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{path.name} is damaged, cut off or no Parquet file. Copy or write it again.") from error
    _refuse_repeated(path, content.column_names)
    units = {f.name: f.metadata[b"unit"].decode() for f in content.schema if f.metadata and b"unit" in f.metadata}
    return Sheet(path, {name: _plain(content[name]) for name in content.column_names}, units)


def _read_csv(path: Path) -> Sheet:
    header = _header(path)
    faulty: list[arrow_csv.InvalidRow] = []

    def remember(row: arrow_csv.InvalidRow) -> str:
        faulty.append(row)
        return "error"

    # Everything is read as text, the header too: Arrow's own guess of types fails far from the entry that is at fault.
    texts = {f"f{i}": pa.string() for i in range(header.count(",") + 1)}
    try:
        content = arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(autogenerate_column_names=True, use_threads=False),
            parse_options=arrow_csv.ParseOptions(invalid_row_handler=remember),
            convert_options=arrow_csv.ConvertOptions(column_types=texts, strings_can_be_null=True),
        )
    except (pa.ArrowException, OSError) as error:
        raise _unreadable_csv(path, faulty) from error
    names = [str(column[0].as_py() or "").strip() for column in content.columns]
    if names and all(_is_number(name) for name in names):
        raise DataError(f"{path.name} starts with numbers. Its first line must name the columns, e.g. t,phi,u.")
    _refuse_repeated(path, [name for name in names if name])
    return Sheet(path, {name: column[1:] for name, column in zip(names, content.columns, strict=True) if name})


def _header(path: Path) -> str:
    """First line of a CSV file.

    Raises:
        DataError: it is not UTF-8 text, or its separator is not a comma.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = file.readline()
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text. Save it as CSV in UTF-8.") from error
    for separator, name in ((";", "';'"), ("\t", "a tab")):
        if separator in header and "," not in header:
            raise DataError(
                f"{path.name} separates its columns by {name}; a comma is needed. Convert it once: "
                f"pandas.read_csv('{path.name}', sep={separator!r}, decimal=',').to_csv(..., index=False), "
                "with decimal='.' if its numbers have a decimal point."
            )
    return header


def _unreadable_csv(path: Path, faulty: list[arrow_csv.InvalidRow]) -> DataError:
    if not faulty:
        return DataError(f"{path.name} cannot be read as CSV: it is empty, damaged or not UTF-8 text.")
    row = faulty[0]
    comma = (
        " If its numbers have a decimal comma (0,5), write 0.5." if row.actual_columns > row.expected_columns else ""
    )
    return DataError(
        f"{path.name} has {row.expected_columns} columns, but record {row.number} (the header is record 1) has "
        f"{row.actual_columns}: {row.text[:60]!r}.{comma}"
    )


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
