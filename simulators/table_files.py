"""CSV files of tables, read into the YAML node that names them: what is kept of a run must not need the file again."""

import csv
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from simulators.quantity import ModelError

READ_FROM = "read_from"  # key that says where the numbers came from


def with_files_read(sim: Any, folders: Sequence[Path]) -> Any:
    """Return a `sim:` node, or one that another is based on, with axes and values in place of files.

    What is no node of a simulator is returned as it is: its own checks say what is wrong with it.

    Args:
        sim: the node.
        folders: where relative paths start, in this order.

    Raises:
        ModelError: a file that is missing or not a table.
    """
    if not isinstance(sim, Mapping):
        return sim
    node = dict(sim)
    if "base" in node:
        node["base"] = with_files_read(node["base"], folders)
    if isinstance(node.get("tables"), Mapping):
        node["tables"] = {
            name: with_file_read(f"sim.tables.{name}", table, folders) for name, table in node["tables"].items()
        }
    return node


def with_file_read(path: str, table: Any, folders: Sequence[Path]) -> Any:
    """Return the node of a table with axes and values in place of its file, and where they came from."""
    if not isinstance(table, Mapping) or "file" not in table:
        return table
    for key in ("axes", "values"):
        if key in table:
            raise ModelError(f"{path}.{key}: given beside file; leave out file, or axes and values")
    inputs = table.get("inputs")
    if not isinstance(inputs, list | tuple) or len(inputs) not in (1, 2):
        return table  # refused where the table is read
    file = _found(f"{path}.file", table["file"], folders)
    axes, values = _read(f"{path}.file", file, [str(name) for name in inputs])
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    kept = {key: value for key, value in table.items() if key != "file"}
    return kept | {"axes": axes, "values": values, READ_FROM: {"file": str(file), "sha256": digest}}


def files_of(sim: Any) -> dict[str, str]:
    """Return the files that the tables of a node came from, and the SHA-256 of each."""
    found: dict[str, str] = {}
    if isinstance(sim, Mapping):
        found |= files_of(sim.get("base"))
        tables = sim.get("tables")
        for table in tables.values() if isinstance(tables, Mapping) else ():
            origin = table.get(READ_FROM) if isinstance(table, Mapping) else None
            if isinstance(origin, Mapping) and {"file", "sha256"} <= origin.keys():
                found[str(origin["file"])] = str(origin["sha256"])
    return found


def _found(path: str, file: Any, folders: Sequence[Path]) -> Path:
    if not isinstance(file, str) or not file:
        raise ModelError(f"{path}: {file!r} is no name of a file; write e.g. file: map.csv")
    tried = [(folder / file).absolute() for folder in folders]
    for candidate in tried:
        if candidate.is_file():
            return candidate
    where = " and ".join(dict.fromkeys(str(candidate) for candidate in tried))
    raise ModelError(
        f"{path}: {file} is missing; looked for {where}. A relative path starts at the folder of the YAML, then at the "
        "working directory"
    )


def _read(path: str, file: Path, inputs: list[str]) -> tuple[list[list[float]], list[Any]]:
    """Return axes and values of a CSV with one column per input and one of values."""
    try:
        lines = list(csv.reader(file.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, ValueError, csv.Error) as error:
        raise ModelError(f"{path}: {file.name} is not readable ({error}); save it as CSV in UTF-8") from None
    rows = [(number, cells) for number, cells in enumerate(lines, 1) if any(cell.strip() for cell in cells)]
    expected = f"{len(inputs) + 1} columns, {', '.join(inputs)} and the value, separated by commas"
    for number, cells in rows:
        if len(cells) != len(inputs) + 1:
            raise ModelError(f"{path}: {file.name}, line {number}: {len(cells)} columns; a table has {expected}")
    if not rows or all(_number(cell) is not None for cell in rows[0][1]):
        raise ModelError(f"{path}: {file.name} begins with no header line; name the {expected}")
    head = [cell.strip() for cell in rows[0][1][:-1]]
    if head != inputs and sorted(head) == sorted(inputs):
        raise ModelError(
            f"{path}: {file.name} has the columns {', '.join(head)}, inputs are [{', '.join(inputs)}]; write them in one order"
        )
    points: dict[tuple[float, ...], float] = {}
    for number, cells in rows[1:]:
        numbers = [_number(cell) for cell in cells]
        for cell, value in zip(cells, numbers, strict=True):
            if value is None or not math.isfinite(value):
                raise ModelError(
                    f"{path}: {file.name}, line {number}: {cell.strip()!r} is not a finite number; fill it in, or leave out "
                    "its row (with two inputs, all rows of that node)"
                )
        *at, last = (float(value) for value in numbers if value is not None)
        if tuple(at) in points:
            raise ModelError(f"{path}: {file.name}, line {number}: {_at(inputs, at)} stands there twice; keep one row")
        points[tuple(at)] = last
    axes = [list(dict.fromkeys(point[i] for point in points)) for i in range(len(inputs))]
    if len(inputs) == 1:
        return axes, list(points.values())
    axes = [sorted(axis) for axis in axes]
    lacking = [(a, b) for a in axes[0] for b in axes[1] if (a, b) not in points]
    if lacking:
        raise ModelError(
            f"{path}: {file.name} is no full grid: {len(axes[0])} x {len(axes[1])} nodes, {len(lacking)} without a value, "
            f"first {_at(inputs, lacking[0])}; add its row, or leave out the node everywhere"
        )
    return axes, [[points[a, b] for b in axes[1]] for a in axes[0]]


def _at(inputs: Sequence[str], values: Sequence[float]) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in zip(inputs, values, strict=True))


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
