"""A CSV file as columns of text: separator, comments, units, decimal commas are found out where there is one way to read."""

import csv
import io
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv

from simpel_cli.data.tables.formats.csv_header import Header, are_units, header_of
from simpel_cli.errors import DataError

BLANKS = " "  # any number of blanks and tabs
SEPARATORS = {",": "a comma", ";": "a semicolon", "\t": "a tab", BLANKS: "blanks"}
COMMENT = re.compile(r"^[ \t]*#", re.M)
SAMPLE = 50  # rows that decide on the separator
POINT, COMMA, BOTH, THOUSANDS = ".", ",", "both", "thousands"  # what numbers are written with; the last two: in doubt
WITH_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
WITH_POINT = re.compile(r"[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?")
IN_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")  # 1,234 may be 1.234 or 1234; 0,123 is no thousand


class Dialect(NamedTuple):
    """How a CSV file is written.

    Args:
        separator: one of `SEPARATORS`.
        names: of the columns, where a comment line above the first row gives them; None: the first line does.
        comments: whether there are lines that begin with #.
        units: of the columns, where a row of their own gives them.
        units_line: whether that row stands between header and numbers, and is no comment.
        decimal: what the numbers are written with: `POINT`, `COMMA`, or in doubt `BOTH` or `THOUSANDS`.
    """

    separator: str = ","
    names: tuple[str, ...] | None = None
    comments: bool = False
    units: tuple[str, ...] = ()
    units_line: bool = False
    decimal: str = POINT


def read_csv(path: Path) -> tuple[dict[str, pa.ChunkedArray], Header, Dialect]:
    """Read a CSV file: name -> column of text, what the header says, how it is written.

    Raises:
        DataError: it is not UTF-8, can be read in two ways, has no header, a row with too many or too few entries, or a unit
            in its header that the row of units contradicts.
    """
    try:
        content = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text. Save it as CSV in UTF-8.") from error
    dialect = _dialect(path, content)
    # Everything is read as text, the header too: Arrow's own guess of types fails far from the entry that is at fault.
    table = _parse(path, _plain(content, dialect), dialect)
    if dialect.names is not None and len(dialect.names) == len(table.columns):
        names, columns = list(dialect.names), list(table.columns)
    else:
        names, columns = _below_header(path, table, dialect)
        dialect = dialect._replace(units=())
        if below := _units_below(columns):
            dialect = dialect._replace(units=below, units_line=True)
            columns = [column[1:] for column in columns]
    try:
        header = header_of(names, dialect.units)
    except ValueError as error:
        raise DataError(f"{path.name}: {error}. Correct one of them, or leave it empty.") from error
    named = {name: column for name, column in zip(header.names, columns, strict=True) if name}
    return named, header, dialect._replace(decimal=_decimal(list(named.values()), dialect.separator))


def _below_header(path: Path, table: pa.Table, dialect: Dialect) -> tuple[list[str], list[pa.ChunkedArray]]:
    """Names in the first row, and the columns below them."""
    names = [str(column[0].as_py() or "").strip() for column in table.columns]
    if names and all(_is_number(name, dialect.separator) for name in names):
        raise DataError(f"{path.name} starts with numbers. Its first line must name the columns, e.g. t,phi,u.")
    repeated = [name for i, name in enumerate(names) if name and name in names[:i]]
    if repeated:
        raise DataError(f"{path.name} has more than one column named {', '.join(repeated)}. Give each its own name.")
    return names, [column[1:] for column in table.columns]


def _units_below(columns: list[pa.ChunkedArray]) -> tuple[str, ...]:
    """The row of units below the header; empty: there is none."""
    if not columns or len(columns[0]) < 2:
        return ()
    texts = [str(column[0].as_py() or "").strip() for column in columns]
    rests = [[str(v).strip() for v in column[1 : SAMPLE + 1].to_pylist() if v is not None] for column in columns]
    numeric = [bool(rest) and all(_is_number(v, ";") for v in rest) for rest in rests]
    return tuple(texts) if are_units(texts, numeric) else ()


def _decimal(columns: list[pa.ChunkedArray], separator: str) -> str:
    """What the numbers of a file are written with."""
    if separator == ",":
        return POINT  # 0,5 would be two entries; in quotes it is refused
    trimmed = [pc.utf8_trim_whitespace(column) for column in columns]
    with_comma = [column.filter(_matches(column, WITH_COMMA)) for column in trimmed]
    if not any(map(len, with_comma)):
        return POINT
    if any(pc.any(_matches(column, WITH_POINT)).as_py() for column in trimmed):
        return BOTH
    return THOUSANDS if all(pc.all(_matches(c, IN_THOUSANDS)).as_py() for c in with_comma if len(c)) else COMMA


def _matches(column: pa.ChunkedArray, pattern: re.Pattern[str]) -> pa.ChunkedArray:
    return pc.fill_null(pc.match_substring_regex(column, f"^(?:{pattern.pattern})$"), False)


def line_of(path: Path, dialect: Dialect, index: int) -> int:
    """Line of a file, counted from 1, on which the record of a row (from 0) ends."""
    header = (dialect.names is None) + dialect.units_line
    line = index + 1 + header
    with suppress(csv.Error), path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        reader = csv.reader(file, delimiter=dialect.separator)
        filled = (
            reader.line_num
            for record in reader
            if (any(record) if dialect.separator == BLANKS else record)
            and not (dialect.comments and "".join(record).lstrip().startswith("#"))
        )
        line = next(islice(filled, index + header, None), line)
    return line


def _dialect(path: Path, content: str) -> Dialect:
    comments = COMMENT.search(content) is not None
    rows: list[str] = []
    remarks: list[str] = []  # above the first row
    for line in filter(str.strip, io.StringIO(content)):
        if not line.lstrip().startswith("#"):
            rows.append(line.rstrip("\n"))
        elif not rows:
            remarks.append(line)
        if len(rows) == SAMPLE:
            break
    if not rows:
        if comments:
            raise DataError(f"{path.name} has comment lines (#) only. Its first line without # must name the columns.")
        return Dialect()
    separator = _separator(path, rows)
    if not (remarks and all(_is_number(field, separator) for field in _fields(rows[0], separator))):
        return Dialect(separator, None, comments)
    width = len(_fields(rows[0], separator))
    found = [_names_in(remark, width) for remark in remarks[-2:]]
    if len(found) == 2 and found[0] and are_units(found[1] or (), [True] * len(found[1] or ())):
        return Dialect(separator, found[0], comments, found[1] or ())  # names, and their units below them
    return Dialect(separator, found[-1], comments)


def _separator(path: Path, rows: list[str]) -> str:
    """Find the separator that gives every sampled row as many entries as the header; a comma if there is none."""
    widths = {s: len(_fields(rows[0], s)) for s in (",", ";", "\t")}
    numbers = [s for s in SEPARATORS if len(f := _fields(rows[0], s)) > 1 and all(_is_number(entry, s) for entry in f)]
    if len(numbers) == 1:
        return numbers[0]  # the names stand in a comment
    able = [s for s, width in widths.items() if width > 1]
    fitting = [s for s in able if all(len(_fields(row, s)) == widths[s] for row in rows)]
    if len(fitting) > 1:
        ways = " or ".join(f"{SEPARATORS[s]} ({widths[s]} columns)" for s in fitting)
        raise DataError(
            f"{path.name} can be read in two ways: its columns are separated by {ways}. "
            "Write it with one of them only, and numbers with a decimal point."
        )
    if fitting or able:
        return (fitting or able)[0]
    words = {len(row.split()) for row in rows[1:]} or {len(rows[0].split())}
    if len(words) > 1 or words == {1}:
        return ","
    if words != {len(rows[0].split())}:
        raise DataError(
            f"{path.name} separates its {words.pop()} columns by blanks, but its header has {len(rows[0].split())} words: "
            f"{rows[0].strip()[:60]!r}. Write names without blanks, or separate the columns by commas."
        )
    return BLANKS


def _fields(line: str, separator: str) -> list[str]:
    if separator == BLANKS:
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _names_in(comment: str, width: int) -> tuple[str, ...] | None:
    """Names of the columns in a comment line such as `# t phi u`; None where it does not read as that."""
    text = comment.lstrip().lstrip("#")
    for names in ([f.strip() for f in re.split(r"[,;\t]", text)], re.split(r"[,;\s]+", text.strip())):
        if len(names) == width and not any(map(_is_number, names)):
            return tuple(names)
    return None


def _plain(content: str, dialect: Dialect) -> bytes:
    """Content without comments, blanks as separators made into tabs."""
    if dialect.comments:
        content = "".join(line for line in io.StringIO(content) if not line.lstrip().startswith("#"))
    if dialect.separator == BLANKS:
        content = "".join("\t".join(line.split()) + "\n" for line in io.StringIO(content))
    return content.encode()


def _parse(path: Path, content: bytes, dialect: Dialect) -> pa.Table:
    faulty: list[arrow_csv.InvalidRow] = []

    def remember(row: arrow_csv.InvalidRow) -> str:
        faulty.append(row)
        return "error"

    delimiter = "\t" if dialect.separator == BLANKS else dialect.separator
    width = content.partition(b"\n")[0].count(delimiter.encode()) + 1
    try:
        return arrow_csv.read_csv(
            io.BytesIO(content),
            read_options=arrow_csv.ReadOptions(autogenerate_column_names=True, use_threads=False),
            parse_options=arrow_csv.ParseOptions(delimiter=delimiter, invalid_row_handler=remember),
            convert_options=arrow_csv.ConvertOptions(
                column_types={f"f{i}": pa.string() for i in range(width)}, strings_can_be_null=True
            ),
        )
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, faulty, dialect) from error


def _unreadable(path: Path, faulty: list[arrow_csv.InvalidRow], dialect: Dialect) -> DataError:
    if not faulty:
        return DataError(f"{path.name} cannot be read as CSV: it is empty, damaged or not UTF-8 text.")
    row = faulty[0]
    comma = ""
    if dialect.separator == "," and row.actual_columns > row.expected_columns:
        comma = " If its numbers have a decimal comma (0,5), write 0.5."
    counted = "the header is record 1" + (", comments are not counted" if dialect.comments else "")
    return DataError(
        f"{path.name} has {row.expected_columns} columns, but record {row.number} ({counted}) has "
        f"{row.actual_columns}: {row.text[:60]!r}.{comma}"
    )


def _is_number(text: str, separator: str = ",") -> bool:
    """Whether an entry is a number, with a decimal comma if no comma separates the columns."""
    if separator != "," and WITH_COMMA.fullmatch(text):
        return True
    try:
        float(text)
    except ValueError:
        return False
    return True
