"""Columns that a formula makes of the columns of a file: a speed from its two components, an angle in radians."""

from collections.abc import Mapping
from dataclasses import replace

import casadi
import numpy as np

from simpel_cli.data.tables.table import Table
from simpel_cli.errors import ConfigError
from simulators.expression import ExpressionError, parse, symbols_used


def with_computed(table: Table, formulas: Mapping[str, str]) -> Table:
    """Return the table with one column more per formula; a formula may use those before it.

    Args:
        table: as read.
        formulas: name of the new column -> formula in names of columns, see `simulators.expression.parse`.

    Raises:
        ConfigError: the name is taken, the formula is none, or it uses a column that is not there.
        DataError: a column that it uses holds text.
    """
    for name, formula in formulas.items():
        key = f"data.computed.{name}"
        if name in table.columns:
            raise ConfigError(f"{key}: {table.name} has a column of this name already. Give the new one another name.")
        try:
            names = sorted(symbols_used(formula))
            lacking = [n for n in names if n not in table.columns]
            if lacking:
                raise table.missing(lacking[0], f"{key} uses it: {formula}")
            symbols = {n: casadi.SX.sym(n) for n in names}
            rule = casadi.Function("rule", list(symbols.values()), [parse(formula, symbols)])
        except ExpressionError as error:
            raise ConfigError(f"{key}: {error}") from error
        if not names:
            raise ConfigError(f"{key}: {formula!r} uses no column. Name those that it is made of.")
        columns = np.array([table.numbers(n) for n in names])
        values = np.asarray(rule.map(len(table))(*columns[:, None, :]))[0]
        values[np.isnan(columns).any(axis=0)] = np.nan  # max(nan, 0) is 0 to CasADi
        table = replace(table, computed=table.computed | {name: values})
    return table
