"""A file of any kind that can be read, as a `Sheet`."""

from collections.abc import Callable
from pathlib import Path

from simpel_cli.data.tables.formats.csv_file import COMMA, Dialect, read_csv
from simpel_cli.data.tables.formats.csv_header import Header
from simpel_cli.data.tables.formats.hdf5_file import read_hdf5
from simpel_cli.data.tables.formats.mat_file import read_mat
from simpel_cli.data.tables.formats.mcap_file import read_mcap
from simpel_cli.data.tables.formats.parquet_file import read_parquet
from simpel_cli.data.tables.formats.rosbag import read_rosbag
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError

Reader = Callable[[Path], Sheet]


def read_sheet(path: Path, key: str = "data.path") -> Sheet:
    """Read a file by its extension, or the folder of a rosbag2.

    Args:
        path: of the file.
        key: that names it, for messages.

    Raises:
        DataError: it has another extension, or the file is empty, damaged, has no rows, repeats a name or is written in a way
            that cannot be read.
    """
    reader = read_rosbag if path.is_dir() else READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(
            f"{key}: {path.name} ends in '{path.suffix}', only {', '.join(READERS)} and the folder of a rosbag2 can be "
            "read."
        )
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(f"{path.name} is empty (0 bytes).")
    sheet = reader(path)
    if not sheet.columns:
        raise DataError(f"{path.name} has no named columns.")
    if len(sheet) == 0:
        raise DataError(f"{path.name} has a header ({', '.join(sheet.columns)}) but no rows.")
    return sheet


def _read_csv(path: Path) -> Sheet:
    columns, header, dialect = read_csv(path)
    unusable = {
        name: f"'{name}' of {path.name} may be {' or '.join(map(repr, texts))}. Name the column by its whole header."
        for name, texts in header.doubtful.items()
    }
    return Sheet(path, columns, header.units, dialect, header.full, unusable, _notes(header, dialect))


def _notes(header: Header, dialect: Dialect) -> tuple[str, ...]:
    notes = []
    if header.units:
        notes.append("units in a row of their own" if dialect.units else "units in the header")
    if dialect.decimal == COMMA:
        notes.append("decimal commas")
    return tuple(notes)


READERS: dict[str, Reader] = {
    ".parquet": read_parquet,
    ".csv": _read_csv,
    ".mat": read_mat,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".mcap": read_mcap,
    ".db3": read_rosbag,
}
