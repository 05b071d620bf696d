"""A run as its directory: a new one is begun with configuration and manifest, a kept one is read back to be resumed."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from simpel_cli.config.build import build_settings
from simpel_cli.config.group_classes import SIMULATORS
from simpel_cli.config.resolved import dump, of_run
from simpel_cli.errors import ConfigError
from simpel_cli.runs.directory import make_directory, refuse_occupied
from simpel_cli.runs.files import write_text
from simpel_cli.runs.manifest import Manifest, read_manifest, refuse_changed_config
from simpel_cli.runs.settings import Settings
from simpel_cli.studies.declared import Declared, declare
from simulators.table_files import files_of


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
    with Manifest(directory, verb, settings, inputs=read_into(config)) as manifest:
        yield declare(config, settings), manifest


def read_into(config: dict[str, Any]) -> dict[str, str]:
    """Return the files whose numbers a configuration holds, with their SHA-256: a run does not need them again."""
    return {file: digest for key in SIMULATORS for file, digest in files_of(config.get(key)).items()}


class KeptRun(NamedTuple):
    """What a run directory says of its run, before any group but `run` is built: a complete run may lack a plug-in today.

    Args:
        record: its manifest.
        config: resolved.
        settings: the group `run`.
    """

    record: dict[str, Any]
    config: dict[str, Any]
    settings: Settings


def kept_run(verb: str, directory: Path) -> KeptRun:
    """Read back a run that is to be resumed.

    Raises:
        ConfigError: of another verb or version, or its configuration was changed.
    """
    record = read_manifest(directory)
    if record["command"] != verb:
        raise ConfigError(f"{directory}: made by `simpel {record['command']}`, not by `simpel {verb}`.")
    refuse_changed_config(directory, record)
    config = of_run(directory)
    return KeptRun(record, config, build_settings(config))
