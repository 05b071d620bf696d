"""Tables of other sensors of the same rig (`data.join`): what is read of them, and which columns they add."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from simpel_cli.data.config import Measurements
from simpel_cli.data.tables.locate import locate
from simpel_cli.data.tables.table import Table, read_table
from simpel_cli.errors import ConfigError


class Joined(NamedTuple):
    """A table of other sensors, read.

    Args:
        key: its place in the data YAML, `data.join[0]`.
        table: its files.
        time: column of the time.
        columns: that are taken of it.
        episode: column of the episode's name; None: its rows are matched by time alone.
    """

    key: str
    table: Table
    time: str
    columns: tuple[str, ...]
    episode: str | None


def read_joined(config: Measurements, main: Table, base: Path) -> tuple[Joined, ...]:
    """Read the tables of `data.join`.

    Args:
        config: the data YAML, with short names.
        main: the table of `data.path`, with computed columns.
        base: folder of the config file.

    Raises:
        ConfigError: `episode` without `data.episode`, or two tables that have a column of one name.
        DataError: a file or a column is missing.
    """
    found: list[Joined] = []
    for entry in config.joined:
        files = [file for path in entry.paths for file in locate(path, base, entry.key)]
        table = read_table(tuple(file.path for file in files), [file.named for file in files], entry.key)
        full = table.full
        time, episode = full.get(entry.time, entry.time), entry.episode
        if time not in table.columns:
            raise table.missing(time, f"Name the column of the time in {entry.key}.time.")
        if episode is not None and config.episode is None:
            raise ConfigError(
                f"{entry.key}.episode: '{episode}', but the rows of data.path have no episodes by name. Name their column: "
                f"data.episode: <name>; or leave {entry.key}.episode out, then rows are matched by time alone."
            )
        if episode is None and config.episode in table.columns:
            episode = config.episode
        if episode is not None:
            episode = full.get(episode, episode)
            if episode not in table.columns:
                raise table.missing(episode, f"Name the right column in {entry.key}.episode.")
        columns = _taken(entry.columns, table, main, {time, episode}, entry.key)
        found.append(Joined(entry.key, table, time, columns, episode))
    _refuse_twice(found)
    return tuple(found)


def _taken(asked: tuple[str, ...] | None, table: Table, main: Table, own: set[str | None], key: str) -> tuple[str, ...]:
    if asked is None:
        return tuple(name for name in table.columns if name not in main.columns and name not in own)
    columns = tuple(table.full.get(name, name) for name in asked)
    for name in columns:
        if name not in table.columns:
            raise table.missing(
                name, f"Name columns of this table in {key}.columns, or leave them out: then all are taken."
            )
    return columns


def _refuse_twice(found: Sequence[Joined]) -> None:
    home: dict[str, Joined] = {}
    for joined in found:
        for name in joined.columns:
            if name in home:
                raise ConfigError(
                    f"{joined.key}: {joined.table.name} has a column '{name}', and so has {home[name].table.name} "
                    f"({home[name].key}). Say in one of them which columns are taken: {joined.key}.columns: [<name>]."
                )
            home[name] = joined
