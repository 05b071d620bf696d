"""Columns that a formula makes of the columns of a file: a speed from its two components, an angle in radians."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi
import numpy as np

from simpel_cli.data.tables.table import Table
from simpel_cli.errors import ConfigError
from simulators.expression import ExpressionError, parse, symbols_used

COMPOUND = re.compile(r"[A-Za-z_]\w*(?:[./]\w+)+")  # imu.gyro.x, group/name


def with_computed(table: Table, formulas: Mapping[str, str]) -> Table:
    """Return the table with one column more per formula; a formula may use those before it.

    Args:
        table: as read.
        formulas: name of the new column -> formula in names of columns, see `simulators.expression.parse`; names of fields,
            such as `imu.gyro.x`, may stand in it as they are.

    Raises:
        ConfigError: the name is taken, the formula is none, or it uses a column that is not there.
        DataError: a column that it uses holds text.
    """
    for name, formula in formulas.items():
        key = f"data.computed.{name}"
        if name in table.columns:
            raise ConfigError(f"{key}: {table.name} has a column of this name already. Give the new one another name.")
        plain, compound = _with_plain_names(formula, table.columns, key)
        try:
            names = sorted(symbols_used(plain))
            lacking = [n for n in names if n not in table.columns and n not in compound]
            if lacking:
                raise table.missing(lacking[0], f"{key} uses it: {formula}")
            symbols = {n: casadi.SX.sym(n) for n in names}
            rule = casadi.Function("rule", list(symbols.values()), [parse(plain, symbols)])
        except ExpressionError as error:
            raise ConfigError(f"{key}: {error}") from error
        if not names:
            raise ConfigError(f"{key}: {formula!r} uses no column. Name those that it is made of.")
        columns = np.array([table.numbers(compound.get(n, n)) for n in names])
        values = np.asarray(rule.map(len(table))(*columns[:, None, :]))[0]
        values[np.isnan(columns).any(axis=0)] = np.nan  # max(nan, 0) is 0 to CasADi
        table = replace(table, computed=table.computed | {name: values})
    return table


def _with_plain_names(formula: str, columns: Sequence[str], key: str) -> tuple[str, dict[str, str]]:
    """Return the formula with names of letters, digits and _ only, of the same length, and which columns they stand for.

    Raises:
        ConfigError: `a/b` may be a column or a quotient of two.
    """
    found: dict[str, str] = {}
    names = sorted((c for c in columns if c in formula and COMPOUND.fullmatch(c)), key=len, reverse=True)
    if not names:
        return formula, found

    def plain(match: re.Match[str]) -> str:
        column = match[0]
        parts = column.split("/")
        if len(parts) > 1 and all(part in columns for part in parts):
            raise ConfigError(
                f"{key}: {column} may be that column or a quotient of columns. Write `{' / '.join(parts)}` for that."
            )
        stand_in = re.sub(r"[./]", "_", column)
        while stand_in in columns or found.get(stand_in, column) != column:
            stand_in += "_"
        found[stand_in] = column
        return stand_in

    every = "|".join(map(re.escape, names))
    return re.sub(rf"(?<![\w.])(?:{every})(?![\w.])", plain, formula), found
