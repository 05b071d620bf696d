"""One file or several with the same columns, read as one table: the rows of a file follow those of the file before."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from simpel_cli.data.tables.read_file import read_sheet
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError, did_you_mean

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Table:
    """Columns of one or several files.

    Args:
        sheets: the files, in the order of `data.path`, with the same columns.
        added: columns of text that stand in none of them, (n,) each.
        computed: columns of numbers, likewise.
    """

    sheets: tuple[Sheet, ...]
    added: dict[str, np.ndarray] = field(default_factory=dict)
    computed: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum(map(len, self.sheets))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return (*self.sheets[0].columns, *self.added, *self.computed)

    @property
    def name(self) -> str:
        """File names, for messages."""
        return ", ".join(sheet.path.name for sheet in self.sheets)

    @property
    def full(self) -> dict[str, str]:
        """Other names of columns -> name, see `Sheet`."""
        return {text: name for sheet in self.sheets for text, name in sheet.full.items()}

    @property
    def unusable(self) -> dict[str, str]:
        """Names of what is no column in one of the files -> why, see `Sheet`."""
        return {name: why for sheet in self.sheets for name, why in sheet.unusable.items()}

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that was read."""
        return tuple(part for sheet in self.sheets for part in sheet.parts or (sheet.path,))

    @property
    def notes(self) -> tuple[str, ...]:
        """How the files were read, where there is something to say."""
        names: dict[str, list[str]] = {}
        for sheet in self.sheets:
            for note in sheet.notes:
                names.setdefault(note, []).append(sheet.path.name)
        return tuple(f"{n[0] if len(n) == 1 else f'{len(n)} files'}: {note}" for note, n in names.items())

    @property
    def file(self) -> np.ndarray:
        """Which file a row is from, (n,) index into `sheets`."""
        return np.repeat(np.arange(len(self.sheets)), [len(sheet) for sheet in self.sheets])

    @property
    def stems(self) -> tuple[str, ...]:
        """A short name per file that no other has: `train` of train.csv, or `a-run` where b/run.csv is another."""
        paths = [sheet.path.with_suffix("") for sheet in self.sheets]
        for depth in range(1, max(len(path.parts) for path in paths) + 1):
            names = tuple("-".join(path.parts[-depth:]) for path in paths)  # a slash stands before segments
            if len(set(names)) == len(names):
                return names
        return tuple(str(sheet.path) for sheet in self.sheets)  # run.csv beside run.parquet

    def numbers(self, name: str) -> np.ndarray:
        """Column as float64, shape (n,), see `Sheet.numbers`."""
        if name in self.computed:
            return self.computed[name]
        return np.concatenate([sheet.numbers(name) for sheet in self.sheets])

    def zeros(self, name: str) -> tuple[int | None, ...]:
        """What `numbers` counts a column of time stamps from, in every file, see `Sheet.zero`."""
        return tuple(None if name in self.computed else sheet.zero(name) for sheet in self.sheets)

    def labels(self, name: str) -> np.ndarray:
        """Column as text, shape (n,), see `Sheet.labels`."""
        if name in self.computed:
            return np.array(["" if np.isnan(v) else f"{v:.12g}" for v in self.computed[name]])
        return self.added[name] if name in self.added else np.concatenate([s.labels(name) for s in self.sheets])

    def place(self, index: int) -> str:
        """Name a row as a person finds it, with its file."""
        for sheet in self.sheets:
            if index < len(sheet):
                return f"{sheet.place(index)} of {sheet.path.name}"
            index -= len(sheet)
        raise IndexError(index)

    def missing(self, column: str, cure: str) -> DataError:
        """Error for a column that the files do not have."""
        for name, why in self.unusable.items():
            if column == name or column.startswith(f"{name}."):  # a field of a struct that cannot be read
                return DataError(f"{why}\n{cure}")
        hint = did_you_mean(column, [*self.columns, *self.full])
        has = ", ".join(self.columns)
        return DataError(f"column '{column}' is missing in {self.name} (it has: {has}).{hint}\n{cure}")


def read_table(paths: tuple[Path, ...], named: Sequence[Mapping[str, str]] = (), key: str = "data.path") -> Table:
    """Read files.

    Args:
        paths: of the files.
        named: of each file, column -> text that its name gives; numbers if all files give numbers.
        key: that names the files, for messages.

    Raises:
        DataError: what `read_sheet` refuses, a file that is named twice, or a column that one of the files lacks.
    """
    twice = [path.name for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise DataError(f"{key}: {twice[0]} is named twice. Name each file once.")
    sheets = _with_names(tuple(read_sheet(path, key) for path in paths), named, key)
    for sheet in sheets:
        for other in sheets:
            lacking = [name for name in other.columns if name not in sheet.columns]
            if lacking:
                raise DataError(
                    f"column '{lacking[0]}' is missing in {sheet.path.name}, but {other.path.name} has it "
                    f"({sheet.path.name} has: {', '.join(sheet.columns)}).{did_you_mean(lacking[0], list(sheet.columns))} "
                    f"The files of {key} are read as one and need the same columns: rename, add or remove it."
                )
    return Table(sheets)


def _with_names(sheets: tuple[Sheet, ...], named: Sequence[Mapping[str, str]], key: str) -> tuple[Sheet, ...]:
    """Sheets with the columns that the names of their files give."""
    numeric = {
        name: all(NUMBER.fullmatch(texts[name]) for texts in named if name in texts)
        for texts in named
        for name in texts
    }
    done = []
    for sheet, texts in zip(sheets, named or [{} for _ in sheets], strict=True):
        for name in texts:
            if name in sheet.columns:
                raise DataError(
                    f"{key}: {{{name}}} makes a column '{name}', but {sheet.path.name} has one already. Give it another "
                    "name in the pattern, or write * there."
                )
        added = {
            name: pa.chunked_array([pa.array([float(text) if numeric[name] else text] * len(sheet))])
            for name, text in texts.items()
        }
        done.append(replace(sheet, columns=sheet.columns | added) if added else sheet)
    return tuple(done)
