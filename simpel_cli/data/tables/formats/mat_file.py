"""A MATLAB file as columns: vectors, and the vectors in structs as `struct.field`. Version 7.3 is HDF5 inside."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.data.tables.formats.arrays import Array, sheet_of
from simpel_cli.data.tables.formats.mat_cures import cure
from simpel_cli.data.tables.formats.mat_elements import check_elements
from simpel_cli.data.tables.formats.optional import library
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError, SimpelError

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
TEXT_HEADER = 512  # bytes


class _Contents:
    """What was found in a file so far.

    Args:
        file: its name.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        self.arrays: list[Array] = []
        self.unusable: dict[str, str] = {}

    def refuse(self, name: str, kind: str) -> None:
        """Keep why a variable is no column."""
        self.unusable[name] = f"'{name}' of {self.file} is {kind}, which is not read. {cure(name, kind, self.file)}"


def read_mat(path: Path) -> Sheet:
    """Read a .mat file of any version.

    Raises:
        DataError: it is damaged, or has no vector of numbers; the message names the variables, what they are, and the lines of
            MATLAB that save them in a way that can be read.
    """
    with path.open("rb") as file:
        start = file.read(TEXT_HEADER + len(HDF5_SIGNATURE))
    newest = start[TEXT_HEADER:] == HDF5_SIGNATURE or start.startswith(b"MATLAB 7.3")
    found = _Contents(path.name)
    try:
        (_read_hdf5 if newest else _read_old)(path, found)
    except SimpelError:
        raise
    except Exception as error:  # of a damaged file; the libraries raise whatever their parsers stumble over
        raise DataError(f"{path.name} is damaged, cut off or no MATLAB file. Copy or save it again.") from error
    return sheet_of(path, found.arrays, found.unusable, lambda name: cure(name, "an array", path.name))


def _read_old(path: Path, found: _Contents) -> None:
    from scipy.io import loadmat

    raw = path.read_bytes()
    if 0 not in raw[:4]:  # version 4 begins with small numbers, later ones with a text
        check_elements(raw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of variables that are read twice, and of opaque ones
        content = loadmat(path, struct_as_record=True, squeeze_me=False, chars_as_strings=True)
    for name, value in content.items():
        if not (name.startswith("__") and name.endswith("__") and not isinstance(value, np.ndarray)):
            _add_old(name, value, found)


def _add_old(name: str, value: Any, found: _Contents) -> None:
    from scipy.io.matlab import MatlabFunction, MatlabOpaque
    from scipy.sparse import issparse

    if issparse(value):
        found.refuse(name, "a sparse matrix")
    elif isinstance(value, MatlabFunction):
        found.refuse(name, "a function")
    elif isinstance(value, MatlabOpaque):
        name, kind = _opaque(name, value)
        if name != "__function_workspace__":
            found.refuse(name, f"a MATLAB object ({kind})")
    elif value.dtype.names is not None:
        if value.size != 1:
            found.refuse(name, f"a struct array ({' x '.join(map(str, value.shape))})")
            return
        record = value.reshape(-1)[0]
        for field in value.dtype.names:
            _add_old(f"{name}.{field}", record[field], found)
    elif value.dtype == object:
        texts = [
            str(v.reshape(-1)[0])
            for v in value.reshape(-1)
            if isinstance(v, np.ndarray) and v.dtype.kind == "U" and v.size
        ]
        if value.size and len(texts) == value.size:
            found.arrays.append(Array(name, np.array(texts, dtype=object)))
        else:
            found.refuse(name, "a cell")
    elif not (name.startswith("__") and name.endswith("__")):
        found.arrays.append(Array(name, value))


def _opaque(name: str, value: Any) -> tuple[str, str]:
    """Name and class of an object, e.g. a timeseries; scipy gives them as fields."""
    first = value.reshape(-1)[0]
    texts = [v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in list(first)[:3]]
    return (texts[0] if name in ("None", "") else name), texts[2] if len(texts) > 2 else "unknown"


def _read_hdf5(path: Path, found: _Contents) -> None:
    h5py = library("h5py", "hdf5", path.name)
    with h5py.File(path, "r") as file:
        for name in file:
            if not name.startswith("#"):
                _add_hdf5(name, file[name], file, h5py, found)


def _add_hdf5(name: str, item: Any, file: Any, h5py: Any, found: _Contents) -> None:
    kind = _text(item.attrs.get("MATLAB_class", b""))
    if isinstance(item, h5py.Group):
        if "MATLAB_sparse" in item.attrs:
            found.refuse(name, "a sparse matrix")
        elif any(_is_reference(item[f], h5py) and "MATLAB_class" not in item[f].attrs for f in item):
            found.refuse(name, "a struct array")
        else:
            for field in item:
                _add_hdf5(f"{name}.{field}", item[field], file, h5py, found)
    elif kind == "cell":
        found.refuse(name, "a cell")
    elif "MATLAB_object_decode" in item.attrs or kind not in _PLAIN:
        found.refuse(name, f"a MATLAB object ({kind or 'unknown'})")
    elif "MATLAB_empty" in item.attrs:
        found.refuse(name, "empty")
    elif kind == "char":
        rows = np.atleast_2d(item[()].T)
        texts = ["".join(chr(c) for c in row) for row in rows]
        found.arrays.append(Array(name, np.array(texts, dtype=object)))
    elif item.dtype.names is not None:
        found.refuse(name, "complex")
    else:
        values = np.asarray(item[()]).T
        found.arrays.append(Array(name, values.astype(bool) if kind == "logical" else values))


def _is_reference(item: Any, h5py: Any) -> bool:
    return isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) is not None


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


_PLAIN = (
    "double",
    "single",
    "logical",
    "char",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
