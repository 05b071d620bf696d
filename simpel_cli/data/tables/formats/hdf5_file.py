"""An HDF5 file as columns: its datasets of one dimension, in one group or in several, with their attribute `unit`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.data.tables.formats.arrays import MOST_COLUMNS, Array, sheet_of
from simpel_cli.data.tables.formats.optional import library
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.data.unit_words import canonical
from simpel_cli.errors import DataError, SimpelError

SAVE = "A column is a dataset with one entry per sample."


def read_hdf5(path: Path) -> Sheet:
    """Read an HDF5 file. Datasets of several groups are called `group/name`.

    Raises:
        DataError: it is damaged, has no dataset that is a column, or a dataset with two units.
    """
    h5py = library("h5py", "hdf5", path.name)
    arrays: dict[str, Array] = {}
    unusable: dict[str, str] = {}
    try:
        with h5py.File(path, "r") as file:
            for name, dataset in _datasets(file, h5py, ""):
                _add(name, dataset, path.name, arrays, unusable)
    except SimpelError:
        raise
    except Exception as error:  # of a damaged file; h5py raises OSError, KeyError, RuntimeError, ...
        raise DataError(f"{path.name} is damaged, cut off or no HDF5 file. Copy or write it again.") from error
    if len({name.rpartition("/")[0] for name in arrays}) == 1:
        arrays = {name.rpartition("/")[2]: array for name, array in arrays.items()}
    return sheet_of(path, [a._replace(name=n) for n, a in arrays.items()], unusable, lambda _: SAVE)


def _datasets(group: Any, h5py: Any, above: str) -> Iterator[tuple[str, Any]]:
    """Datasets below a group with their paths; links that lead nowhere, or back, are passed over."""
    for name in group:
        if group.get(name, getlink=True).__class__ is not h5py.HardLink:
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from _datasets(item, h5py, f"{above}{name}/")
        elif isinstance(item, h5py.Dataset):
            yield f"{above}{name}", item


def _add(name: str, dataset: Any, file: str, arrays: dict[str, Array], unusable: dict[str, str]) -> None:
    shape = dataset.shape
    if shape is None or len(shape) > 2 or (len(shape) == 2 and min(shape) > MOST_COLUMNS):
        size = "empty" if shape is None else f"an array of {' x '.join(map(str, shape))}"
        unusable[name] = f"'{name}' of {file} is {size}, not a column. {SAVE}"
        return
    unit = _unit(dataset, name, file)
    if dataset.dtype.names is not None:
        if len(shape) != 1:
            unusable[name] = f"'{name}' of {file} is an array of records, not a column. {SAVE}"
            return
        table = dataset[()]
        for field in dataset.dtype.names:
            _keep(f"{name}.{field}", table[field], "", file, arrays, unusable)
        return
    text = dataset.dtype.kind in "SO"
    _keep(name, dataset.asstr(errors="replace")[()] if text else dataset[()], unit, file, arrays, unusable)


def _keep(name: str, value: Any, unit: str, file: str, arrays: dict[str, Array], unusable: dict[str, str]) -> None:
    values = np.asarray(value)
    if values.dtype.kind == "S":
        values = np.char.decode(values, "utf-8", "replace")
    if values.dtype.kind in "biufcU" or (
        values.dtype.kind == "O" and all(isinstance(v, str) for v in values.reshape(-1))
    ):
        arrays[name] = Array(name, values, unit)
    else:
        unusable[name] = f"'{name}' of {file} holds {values.dtype}, not numbers or texts. {SAVE}"


def _unit(dataset: Any, name: str, file: str) -> str:
    """The attribute `unit` or `units`.

    Raises:
        DataError: there are both, and they differ.
    """
    found = {key: _text(dataset.attrs[key]) for key in ("unit", "units") if key in dataset.attrs}
    if len({canonical(unit) for unit in found.values()}) > 1:
        raise DataError(
            f"dataset '{name}' of {file} has two units: unit is {found['unit']}, units is {found['units']}. Delete one of the "
            "attributes."
        )
    return next(iter(found.values()), "")


def _text(value: Any) -> str:
    flat = np.asarray(value).reshape(-1)
    first = flat[0] if flat.size else ""
    return first.decode(errors="replace") if isinstance(first, bytes) else str(first)
