"""Where the files of `data.path` lie, and which of them are for testing."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import ConfigError, DataError, did_you_mean

BY_FILE = "data.split.test_files"  # column that `by_file` adds to a table


def locate(path: str, base: Path) -> Path:
    """Find the file: an absolute path, else against `base` (the config file's folder), else the working directory.

    Raises:
        DataError: nothing is there; the message lists the places that were tried.
    """
    tried = _places(path, base)
    for candidate in tried:
        if candidate.is_file():
            return candidate.resolve()
    folder = " It is a folder, not a file." if any(c.is_dir() for c in tried) else ""
    places = ", ".join(dict.fromkeys(str(c.resolve()) for c in tried))
    raise DataError(f"data.path: '{path}' was not found.{folder} Tried: {places}.")


def absolute(data: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return a `data:` node that names its files from anywhere; what is no path or not there is left as it is.

    Args:
        data: the node, as YAML gives it.
        base: folder of the config file.
    """

    def found(path: Any) -> Any:
        if not isinstance(path, str):
            return path
        return next((str(p.resolve()) for p in _places(path, base) if p.is_file()), path)

    def all_found(paths: Any) -> Any:
        return [found(path) for path in paths] if isinstance(paths, list | tuple) else found(paths)

    done = dict(data)
    if "path" in done:
        done["path"] = all_found(done["path"])
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
        if len(hits) != 1:
            raise ConfigError(_not_one(entry, table, len(hits)))
        part[hits[0]] = "test"
    if (part == "test").all():
        raise ConfigError(
            f"data.split.test_files: {', '.join(config.split['test_files'])} are all the files of data.path, so that "
            "nothing is left to train on. Name the files for testing only, and list the others in data.path, too."
        )
    return replace(config, split={"column": BY_FILE}), replace(table, added={BY_FILE: part[table.file]})


def _places(path: str, base: Path) -> list[Path]:
    given = Path(path).expanduser()
    return [given] if given.is_absolute() else [base / given, Path.cwd() / given]


def _names(entry: str, path: Path, base: Path) -> bool:
    """Whether an entry means the file: as a path, or as the end of its path."""
    if any(place.is_file() and place.resolve() == path for place in _places(entry, base)):
        return True
    parts = Path(entry).parts
    return path.parts[-len(parts) :] == parts


def _not_one(entry: str, table: Table, hits: int) -> str:
    names = [sheet.path.name for sheet in table.sheets]
    problem = "is none of the files" if hits == 0 else f"stands for {hits} files; give more of its path, of the files"
    return (
        f"data.split.test_files: '{entry}' {problem} of data.path ({', '.join(names)}). data.path lists all files, "
        f"those for testing included.{did_you_mean(Path(entry).name, names) if hits == 0 else ''}"
    )
