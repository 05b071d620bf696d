"""Which column names the episodes, and which one the parts to train and to test on."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.importing.clock import Clock
from simpel_cli.data.importing.columns import Column
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import DataError

NAMED = re.compile(
    r"(?:run|episode|ep|trial|experiment|exp|test|traj|trajectory|sequence|seq|session|drive|flight|lap|drop|versuch|fahrt|id)"
    r"s?(?:_?(?:id|no|nr|number|num|index|name))?",
)
LEAST_ROWS = 2.0  # of an episode, on average


class Parts(NamedTuple):
    """How the rows fall apart.

    Args:
        episode: column; None: there is none, or it is not sure which.
        split: column with the values train and test; None: there is none.
        episodes: number of episodes, those of the files if no column names them.
        starts: rows at which one begins within a file, (k,).
        questions: what only a person can tell.
    """

    episode: str | None
    split: str | None
    episodes: int
    starts: np.ndarray
    questions: tuple[str, ...] = ()


def parts_of(table: Table, columns: Sequence[Column], clock: Clock) -> Parts:
    """Find them.

    Args:
        table: the files.
        columns: of them.
        clock: the time.
    """
    file = table.file
    files = len(table.sheets)
    labels = {c.name: found for c in columns if c.name != clock.column and (found := _labels(table, c)) is not None}
    split = next((name for name, texts in labels.items() if {"train", "test"} <= set(texts.tolist())), None)
    blocks = {n: _changes(t, file) for n, t in labels.items() if n != split and _in_blocks(t, file)}
    if len(clock.starts):
        same = [name for name, changes in blocks.items() if np.array_equal(changes, clock.starts)]
        if same:  # all of them part the rows alike: take one that is called so
            return Parts(next(filter(_is_named, same), same[0]), split, len(clock.starts) + files, clock.starts)
        question = (
            f"{clock.column} starts anew {len(clock.starts)} times, first at {table.place(int(clock.starts[0]))}: these are "
            "several episodes, which a column has to name, and none changes just there. Write `episode: NAME`, and "
            f"`time: {clock.column}` above it, or cut the file."
        )
        return Parts(None, split, len(clock.starts) + files, clock.starts, (question,))
    named = [name for name in blocks if _is_named(name)]
    if named and all(np.array_equal(blocks[name], blocks[named[0]]) for name in named):
        return Parts(named[0], split, len(set(labels[named[0]].tolist())), blocks[named[0]])
    questions = (f"Which column names the episodes: {', '.join(named)}? `episode: {named[0]}`",) if named else ()
    return Parts(None, split, files, np.empty(0, int), questions)


def _labels(table: Table, column: Column) -> np.ndarray | None:
    """A column as names, if it may be some: texts, or whole numbers."""
    values = column.values
    if values is not None and not (np.isfinite(values).all() and np.all(values == np.round(values))):
        return None
    try:
        return table.labels(column.name)
    except DataError:
        return None


def _in_blocks(texts: np.ndarray, file: np.ndarray) -> bool:
    """Whether every name stands in rows that follow each other, and there are several."""
    distinct = len(set(texts.tolist()))
    if distinct < 2 or "" in texts or len(texts) < LEAST_ROWS * distinct:
        return False
    pairs = len({*zip(texts.tolist(), file.tolist(), strict=True)})
    return len(_changes(texts, file)) + len(set(file.tolist())) == pairs


def _changes(texts: np.ndarray, file: np.ndarray) -> np.ndarray:
    """Rows at which a column changes within a file."""
    return np.flatnonzero((texts[1:] != texts[:-1]) & (file[1:] == file[:-1])) + 1


def _is_named(name: str) -> bool:
    return NAMED.fullmatch(re.split(r"[./]", name)[-1].strip().lower()) is not None
