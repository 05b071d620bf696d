"""Names of columns in a data YAML: a column may also be called by its whole header, e.g. `phi [rad]`."""

from collections.abc import Sequence
from dataclasses import replace

from simpel_cli.data.config import Measurements
from simpel_cli.data.tables.table import Table


def with_short_names(config: Measurements, table: Table, outputs: tuple[str, ...] = ()) -> Measurements:
    """Return the data YAML with the name of a column wherever it gives a whole header.

    Args:
        config: the data YAML.
        table: its files.
        outputs: names of the simulator's outputs: one that no key names is left out if it has no column, but not where the
            files have something of its name that cannot be read.

    Raises:
        DataError: there is such an output.
    """
    for name in outputs:
        if name not in config.columns and name not in table.columns and name in table.unusable:
            raise table.missing(name, f"If it was not measured, say `columns: {{{name}: null}}`.")
    full = table.full
    if not full:
        return config

    def short(column: str | None) -> str | None:
        return full.get(column, column) if column is not None and column not in table.columns else column

    split = dict(config.split)
    if "column" in split:
        split["column"] = short(split["column"])
    columns = {quantity: short(column) for quantity, column in config.columns.items()}
    times = {quantity: full.get(column, column) for quantity, column in config.times.items()}
    return replace(
        config, time=short(config.time), episode=short(config.episode), columns=columns, times=times, split=split
    )


def with_names_of_joined(config: Measurements, joined: Sequence[Table], main: Table) -> Measurements:
    """Return the data YAML with the name of a column wherever `columns` gives a whole header of a joined table.

    Args:
        config: the data YAML.
        joined: tables of other sensors.
        main: the table of `data.path`, whose columns precede.
    """
    full = {text: name for table in joined for text, name in table.full.items() if text not in main.columns}
    return replace(config, columns={q: full.get(c, c) if c is not None else None for q, c in config.columns.items()})
