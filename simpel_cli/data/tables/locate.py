"""Where the files of `data.path` lie, and which of them are for testing."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.tables.pattern import Found, is_bag, is_pattern, matches, nearest
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import ConfigError, DataError, did_you_mean

BY_FILE = "data.split.test_files"  # column that `by_file` adds to a table


def locate(path: str, base: Path, key: str = "data.path") -> list[Found]:
    """Find the file, or the files of a pattern.

    Args:
        path: absolute, else tried against `base`, then against the working directory.
        base: the config file's folder.
        key: that names it, for messages.

    Raises:
        ConfigError: the pattern can be read in two ways.
        DataError: nothing is there; the message lists the places that were tried.
    """
    tried = _places(path, base)
    for candidate in tried:
        if found := _at(candidate):
            return found
    if is_pattern(path):
        raise DataError(_no_match(path, tried, key))
    folder = ""
    if any(c.is_dir() for c in tried):
        folder = f" It is a folder, not a file: for the files in it write '{path.rstrip('/')}/*.csv'."
    places = ", ".join(dict.fromkeys(str(c.resolve()) for c in tried))
    raise DataError(f"{key}: '{path}' was not found.{folder} Tried: {places}.")


def absolute(data: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return a `data:` node that names its files from anywhere; what is no path or not there is left as it is.

    Args:
        data: the node, as YAML gives it.
        base: folder of the config file.
    """

    def found(path: Any) -> Any:
        if not isinstance(path, str):
            return path
        place = next((p for p in _places(path, base) if _at(p)), None)
        if place is None:
            return path
        return str(place.resolve()) if _is_one(place) else os.path.abspath(place)

    def all_found(paths: Any) -> Any:
        return [found(path) for path in paths] if isinstance(paths, list | tuple) else found(paths)

    done = dict(data)
    if "path" in done:
        done["path"] = all_found(done["path"])
    if isinstance(done.get("join"), list | tuple):
        done["join"] = [
            dict(node) | {"path": all_found(node["path"])} if isinstance(node, Mapping) and "path" in node else node
            for node in done["join"]
        ]
    split = done.get("split")
    if isinstance(split, Mapping) and isinstance(split.get("test_files"), list | tuple):
        # a bare file name stands for the file of that name in data.path, which need not lie in the same folder
        done["split"] = dict(split) | {
            "test_files": [
                entry if isinstance(entry, str) and entry == Path(entry).name else found(entry)
                for entry in split["test_files"]
            ]
        }
    return done


def by_file(config: Measurements, table: Table, base: Path) -> tuple[Measurements, Table]:
    """Turn `split: {test_files: [...]}` into a split by column; any other split stays as it is.

    Args:
        config: the data YAML.
        table: its files.
        base: folder of the config file.

    Raises:
        ConfigError: an entry that is none of the files, or more than one.
    """
    if "test_files" not in config.split:
        return config, table
    part = np.full(len(table.sheets), "train", dtype="<U5")
    for entry in config.split["test_files"]:
        hits = [i for i, sheet in enumerate(table.sheets) if _names(entry, sheet.path, base)]
        if len(hits) != 1 and not (hits and is_pattern(entry)):
            raise ConfigError(_not_one(entry, table, len(hits)))
        part[hits] = "test"
    if (part == "test").all():
        raise ConfigError(
            f"data.split.test_files: {', '.join(config.split['test_files'])} are all the files of data.path, so that "
            "nothing is left to train on. Name the files for testing only, and list the others in data.path, too."
        )
    return replace(config, split={"column": BY_FILE}), replace(table, added={BY_FILE: part[table.file]})


def _places(path: str, base: Path) -> list[Path]:
    given = Path(path).expanduser()
    return [given] if given.is_absolute() else [base / given, Path.cwd() / given]


def _at(place: Path) -> list[Found]:
    """The file or files at a place; a file of that very name goes before what it would stand for as a pattern."""
    if _is_one(place):
        return [Found(place.resolve(), {})]
    return matches(Path(os.path.abspath(place))) if is_pattern(str(place)) else []


def _is_one(place: Path) -> bool:
    return place.is_file() or is_bag(place)


def _no_match(path: str, tried: list[Path], key: str) -> str:
    looked = {}
    for place in tried:
        folder, names = nearest(Path(os.path.abspath(place)))
        looked[str(folder)] = f"{folder} (nearest there: {', '.join(names) or 'it has no files'})"
    return (
        f"{key}: no file matches '{path}'. Looked in: {'; '.join(looked.values())}. * stands for any text but a slash, ** "
        "for folders, ? for one letter, {name} for text that becomes a column."
    )


def _names(entry: str, path: Path, base: Path) -> bool:
    """Whether an entry means the file: as a path, or as the end of its path, with wildcards or without."""
    if any(_is_one(place) and place.resolve() == path for place in _places(entry, base)):
        return True
    if is_pattern(entry):
        return PurePath(path).match(entry) or any(
            found.path == path for place in _places(entry, base) for found in _at(place)
        )
    parts = Path(entry).parts
    return path.parts[-len(parts) :] == parts


def _not_one(entry: str, table: Table, hits: int) -> str:
    names = [sheet.path.name for sheet in table.sheets]
    problem = "is none of the files" if hits == 0 else f"stands for {hits} files; give more of its path, of the files"
    return (
        f"data.split.test_files: '{entry}' {problem} of data.path ({', '.join(names)}). data.path lists all files, "
        f"those for testing included.{did_you_mean(Path(entry).name, names) if hits == 0 else ''}"
    )
