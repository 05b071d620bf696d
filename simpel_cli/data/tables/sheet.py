"""A file as named columns, with messages that a person can act on."""

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from simpel_cli.data.tables.formats.csv_file import BLANKS, BOTH, COMMA, THOUSANDS, WITH_COMMA, Dialect, line_of
from simpel_cli.errors import DataError


@dataclass(frozen=True)
class Sheet:
    """Columns of a file; a column is converted when it is asked for, so text in an unused one does no harm.

    Args:
        path: the file.
        columns: name -> Arrow column, all of the same length.
        units: name -> unit, as the file gives it.
        dialect: of a CSV file.
        full: other names of columns -> name, e.g. the header `phi [rad]` of the column `phi`.
        unusable: names of what is no column, though one may look for it -> why, and what to do.
        notes: how the file was read, where there is something to say.
        parts: the files that it is made of; empty: the one at `path`.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray]
    units: dict[str, str] = field(default_factory=dict)
    dialect: Dialect = Dialect()
    full: dict[str, str] = field(default_factory=dict)
    unusable: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    parts: tuple[Path, ...] = ()

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
            if self.dialect.decimal == COMMA:
                column = pc.replace_substring(column, ",", ".")
        try:
            numbers = pc.cast(column, pa.float64(), safe=False)
        except pa.ArrowException as error:
            raise self._not_a_number(name, column) from error
        return numbers.to_numpy(zero_copy_only=False).astype(np.float64)

    def zero(self, name: str) -> int | None:
        """Return what `numbers` counts a column of time stamps from, ns since 1970; None: it is a column of numbers."""
        column = self.columns[name]
        if not pa.types.is_timestamp(column.type):
            return None
        first = pc.min(pc.cast(pc.cast(column, pa.timestamp("ns", tz=column.type.tz)), pa.int64())).as_py()
        return 0 if first is None else int(first)

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
        """Name a row as a person finds it: the line of a CSV file, the row of another counted from 0."""
        if self.path.suffix.lower() != ".csv":
            return f"row {index} (counted from 0)"
        return f"line {line_of(self.path, self.dialect, index)}"

    def _not_a_number(self, name: str, column: pa.ChunkedArray) -> DataError:
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            return DataError(f"column '{name}' of {self.path.name} holds {column.type}, not numbers.")
        texts = pc.utf8_trim_whitespace(self.columns[name]).to_pylist()
        index, text = next(
            (i, t) for i, (t, n) in enumerate(zip(texts, column.to_pylist(), strict=True)) if _is_text(n)
        )
        return DataError(
            f"column '{name}' of {self.path.name} should hold numbers, but {self.place(index)} has {text[:40]!r}. "
            f"{self._cure(index, text)}"
        )

    def _cure(self, index: int, text: str) -> str:
        """Say what to do about a text that is no number."""
        if WITH_COMMA.fullmatch(text) and self.dialect.decimal == BOTH:
            return (
                "Other numbers of the file have a decimal point, so that this comma may be a decimal comma or separate "
                "thousands. Write all numbers with a decimal point."
            )
        if WITH_COMMA.fullmatch(text) and self.dialect.decimal == THOUSANDS:
            separator = r"\s+" if self.dialect.separator == BLANKS else self.dialect.separator
            return (
                f"It may be {text.replace(',', '.')} or {text.replace(',', '')}: every comma of the file stands before three "
                f"digits. If it is a decimal comma: pandas.read_csv('{self.path.name}', sep={separator!r}, decimal=',')"
                f".to_csv(..., index=False); if it separates thousands: the same with thousands=','."
            )
        if WITH_COMMA.fullmatch(text):
            return f"It looks like a decimal comma: write {text.replace(',', '.')}."
        if self.dialect.decimal == COMMA:
            return "Write numbers with a decimal comma, without separators of thousands, and leave a missing one empty."
        hint = " A row of units is read as one if every entry is a known unit or empty." if index == 0 else ""
        return f"Write numbers with a decimal point, and leave a missing one empty.{hint}"


def _seconds(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Time stamps as s since the earliest; the difference is taken in whole ns, where float64 would lose digits."""
    stamps = pc.cast(pc.cast(column, pa.timestamp("ns", tz=column.type.tz)), pa.int64())
    return pc.multiply(pc.cast(pc.subtract(stamps, pc.min(stamps)), pa.float64()), 1e-9)


def _is_text(entry: str | None) -> bool:
    """Whether an entry is there and no number."""
    try:
        pc.cast(pa.scalar(entry, pa.string()), pa.float64())
    except pa.ArrowException:
        return True
    return False
