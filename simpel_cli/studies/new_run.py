"""A new run: its directory, the configuration that it keeps, its manifest, and the configuration's groups."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from simpel_cli.config.build import build_settings
from simpel_cli.config.resolved import dump
from simpel_cli.runs.directory import make_directory, refuse_occupied
from simpel_cli.runs.files import write_text
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.declared import Declared, declare


@contextlib.contextmanager
def new_run(
    verb: str, config: dict[str, Any], directory: Path, *, beside: dict[str, Any] | None = None
) -> Iterator[tuple[Declared, Manifest]]:
    """Begin a run. What is wrong with its configuration is noted in its manifest, as whatever goes wrong later.

    Args:
        verb: that runs.
        config: resolved.
        directory: of the run; new, or of one that failed before anything was computed.
        beside: what the run's `config.yaml` holds besides.

    Yields:
        The groups, all built, and the manifest.

    Raises:
        ConfigError: a key, or a directory that cannot be used.
    """
    settings = build_settings(config)
    refuse_occupied(make_directory(directory))
    write_text(directory / "config.yaml", dump(config | (beside or {})))
    with Manifest(directory, verb, settings) as manifest:
        yield declare(config, settings), manifest
