"""What the files of a data YAML hold: the main table with its computed columns, and the tables of other sensors."""

from pathlib import Path
from typing import NamedTuple

from simpel_cli.data.computed import with_computed
from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Source
from simpel_cli.data.tables.column_names import with_names_of_joined, with_short_names
from simpel_cli.data.tables.locate import locate
from simpel_cli.data.tables.table import Table, read_table
from simpel_cli.data.timing.joined_tables import Joined, read_joined


class Files(NamedTuple):
    """Tables as they were read.

    Args:
        config: with the names that columns have in the tables.
        table: of `data.path`.
        joined: of other sensors.
    """

    config: Measurements
    table: Table
    joined: tuple[Joined, ...]


def read_files(config: Measurements, model: Source, base: Path) -> Files:
    """Find and read the files.

    Args:
        config: the data YAML.
        model: names the outputs.
        base: folder of the config file; see `data.reader.read`.

    Raises:
        DataError: a file that is missing or cannot be read.
    """
    found = [file for path in config.paths for file in locate(path, base)]
    table = read_table(tuple(file.path for file in found), [file.named for file in found])
    config = with_short_names(config, table, tuple(q.name for q in model.outputs))
    table = with_computed(table, config.computed)
    joined = read_joined(config, table, base)
    return Files(with_names_of_joined(config, [other.table for other in joined], table), table, joined)
