"""Runs below a directory, whatever put them there: `-m`, scripts, or a copy of their Parquet files alone."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from simpel_cli.errors import SimpelError
from simpel_cli.runs.manifest import read_manifest

MARKS = ("manifest.json", "metrics.parquet", ".hydra")  # a directory with one of them is that of a run
ASIDE = ".failed-"  # in the name of what a failed job has left, see `sweeps.job`


class Found(NamedTuple):
    """A run, as its directory tells.

    Args:
        directory: of the run.
        words: its overrides, as typed.
        status: done, failed, interrupted, running, or "" where nothing was begun.
    """

    directory: Path
    words: tuple[str, ...]
    status: str


def runs_below(root: Path) -> Iterator[Found]:
    """Give the runs below a directory, or the directory itself, in order; not the runs that are parts of another one."""
    for folder, below, files in os.walk(root):
        if any(mark in files or mark in below for mark in MARKS):
            below.clear()
            yield _found(Path(folder))
        else:
            below[:] = sorted((name for name in below if ASIDE not in name), key=_in_order)


def _found(directory: Path) -> Found:
    status = "done" if (directory / "metrics.parquet").exists() else ""  # a copy of the Parquet files alone
    with contextlib.suppress(SimpelError):
        status = str(read_manifest(directory).get("status"))
    return Found(directory, tuple(_words(directory)), status)


def _words(directory: Path) -> list[str]:
    import yaml

    with contextlib.suppress(OSError, yaml.YAMLError):
        found = yaml.safe_load((directory / ".hydra" / "overrides.yaml").read_text())
        if isinstance(found, list):
            return [str(word).removeprefix("++") for word in found]
    return []


def _in_order(name: str) -> tuple[bool, int, str]:
    return (not name.isdigit(), int(name) if name.isdigit() else 0, name)
