"""One file or several with the same columns, read as one table: the rows of a file follow those of the file before."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from simpel_cli.data.tables.sheet import Sheet, read_sheet
from simpel_cli.errors import DataError, did_you_mean


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
        hint = did_you_mean(column, list(self.columns))
        has = ", ".join(self.columns)
        return DataError(f"column '{column}' is missing in {self.name} (it has: {has}).{hint}\n{cure}")


def read_table(paths: tuple[Path, ...]) -> Table:
    """Read .parquet or .csv files.

    Raises:
        DataError: what `read_sheet` refuses, a file that is named twice, or a column that one of the files lacks.
    """
    twice = [path.name for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise DataError(f"data.path: {twice[0]} is named twice. Name each file once.")
    sheets = tuple(read_sheet(path) for path in paths)
    for sheet in sheets:
        for other in sheets:
            lacking = [name for name in other.columns if name not in sheet.columns]
            if lacking:
                raise DataError(
                    f"column '{lacking[0]}' is missing in {sheet.path.name}, but {other.path.name} has it "
                    f"({sheet.path.name} has: {', '.join(sheet.columns)}).{did_you_mean(lacking[0], list(sheet.columns))} "
                    "The files of data.path are read as one and need the same columns: rename, add or remove it."
                )
    return Table(sheets)
