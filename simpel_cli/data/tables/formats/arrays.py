"""Arrays with names, of a MATLAB or HDF5 file, as a table: which of them are columns, and why others are not."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError

MOST_COLUMNS = 100  # of one matrix
SHOWN = 3


class Array(NamedTuple):
    """One array of a file.

    Args:
        name: of the column that it becomes.
        values: numbers or texts, (n,) or (n, k), or a single one.
        unit: as the file gives it; empty: it does not.
    """

    name: str
    values: np.ndarray
    unit: str = ""


def sheet_of(path: Path, arrays: Sequence[Array], unusable: dict[str, str], save: Callable[[str], str]) -> Sheet:
    """Make a table of the arrays that have the same number of rows.

    The number of rows is that of most vectors. A matrix with so many rows becomes columns `name_1`, `name_2`, ...

    Args:
        path: of the file.
        arrays: of numbers or texts.
        unusable: names of what is none -> why.
        save: says how to save an array of that name with one entry per sample.

    Raises:
        DataError: there is no column of numbers, or as many vectors have one number of rows as another.
    """
    unusable = dict(unusable)
    vectors = {a.name: _upright(a.values) for a in arrays}
    vectors = {name: values for name, values in vectors.items() if values.ndim == 1 and len(values) > 1}
    length = _rows(path, vectors, arrays)
    columns: dict[str, pa.ChunkedArray] = {}
    units: dict[str, str] = {}
    for array in arrays:
        values = _upright(array.values)
        reason = _reason(values, length)
        if reason:
            unusable[array.name] = f"'{array.name}' of {path.name} is {reason}. {save(array.name)}"
            continue
        parts = {array.name: values} if values.ndim == 1 else _split(array.name, values)
        columns |= {name: _arrow(part) for name, part in parts.items()}
        units |= dict.fromkeys(parts, array.unit) if array.unit else {}
    if not any(pa.types.is_integer(c.type) or pa.types.is_floating(c.type) for c in columns.values()):
        why = " ".join(list(unusable.values())[:SHOWN])
        raise DataError(f"{path.name} has no vector of numbers. {why}".rstrip())
    return Sheet(path, columns, units, unusable=unusable, notes=_left_out(unusable))


def _rows(path: Path, vectors: dict[str, np.ndarray], arrays: Sequence[Array]) -> int:
    if not vectors:
        tall = {a.values.shape[0] for a in arrays if a.values.ndim == 2 and a.values.shape[0] > a.values.shape[1]}
        return tall.pop() if len(tall) == 1 else 0
    counts = Counter(len(values) for values in vectors.values()).most_common()
    if len(counts) > 1 and counts[0][1] == counts[1][1]:
        names = {length: next(n for n, v in vectors.items() if len(v) == length) for length, _ in counts}
        shown = ", ".join(f"'{name}' has {length}" for length, name in list(names.items())[:SHOWN])
        raise DataError(
            f"{path.name} has vectors of different lengths: {shown}. The columns of a table need the same number of rows: "
            "write one file per recording, and quantities that were sampled at different rates into files of their own."
        )
    return counts[0][0]


def _reason(values: np.ndarray, length: int) -> str:
    """Why an array is no column; empty: it is one or several."""
    if values.dtype.kind == "c":
        return "complex; a column holds real numbers"
    if values.size == 0:
        return "empty"
    if values.size == 1:
        return f"a single {'text' if values.dtype.kind in 'UO' else 'number'} ({values.reshape(-1)[0]}), not a column"
    if values.ndim > 2 or (values.ndim == 2 and (values.shape[0] != length or values.shape[1] > MOST_COLUMNS)):
        return f"an array of {' x '.join(map(str, values.shape))}, not a column" + (
            f" of {length} rows" if length else ""
        )
    if len(values) != length:
        return f"{len(values)} entries long, but the columns have {length} rows"
    return ""


def _upright(values: np.ndarray) -> np.ndarray:
    """A row or a column of a matrix as a vector."""
    flat = values.ndim == 2 and 1 in values.shape
    return values.reshape(-1) if flat or values.size == 1 else values


def _split(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}_{i + 1}": values[:, i] for i in range(values.shape[1])}


def _arrow(values: np.ndarray) -> pa.ChunkedArray:
    if values.dtype.kind in "UO":
        return pa.chunked_array([pa.array([str(v).strip() for v in values], pa.string())])
    if values.dtype.kind == "b":
        values = values.astype(np.int8)
    native = values.astype(values.dtype.newbyteorder("=")) if values.dtype.kind in "iu" else values.astype(np.float64)
    return pa.chunked_array([pa.array(native)])


def _left_out(unusable: dict[str, str]) -> tuple[str, ...]:
    if not unusable:
        return ()
    names = list(unusable)
    more = f", and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return (f"left out, no columns: {', '.join(names[:SHOWN])}{more}",)
