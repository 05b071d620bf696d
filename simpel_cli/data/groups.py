"""Which group a row is of: the ball, the payload, the subject; an input per group that is 1 there."""

import numpy as np

from simpel_cli.data.rows import Rows
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import DataError
from simulators.groups import UNSEEN
from simulators.model import Model

LEAST = 2  # groups: one tells nothing of a spread


def group_names(model: Model, table: Table, rows: Rows) -> dict[str, tuple[str, ...]]:
    """Return the groups of the training rows, by column, in order of appearance, and others of its rows that a simulator knows.

    Args:
        model: that names the columns.
        table: has the columns.
        rows: of it, split.

    Raises:
        DataError: a column is missing, has one group only or one in every row, or changes within an episode.
    """
    found = {}
    for column, key in model.columns_of_groups.items():
        labels = _labels(table, column, key)[rows.number]
        train = rows.split == "train"
        names = tuple(dict.fromkeys(label for label in labels[train].tolist() if label))
        given = [model.known_groups.get(parameter, {}) for parameter, by in model.per.items() if by == column]
        if len(names) < LEAST and not (given and all(given)):
            raise DataError(
                f"{key}: column '{column}' has {len(names)} group in the training rows"
                f"{f' ({names[0]})' if names else ''}, which tells nothing of a spread. Leave it out, or train on more "
                "groups."
            )
        if len(names) > 0.5 * train.sum():
            raise DataError(
                f"{key}: column '{column}' has {len(names)} groups in {int(train.sum())} training rows: "
                "it names rows, not groups. Name a column that is the same over whole episodes."
            )
        if rows.next_states.shape[1] == 0:
            _refuse_changes(rows, labels, column, key)
        known = (name for values in given for name in values if name in labels)
        found[column] = tuple(dict.fromkeys([*names, *known]))
    return found


def with_groups(rows: Rows, table: Table, groups: dict[str, tuple[str, ...]]) -> Rows:
    """Return rows with an input per group behind the others; rows of a group that is not known are of `another`.

    Args:
        rows: of the table.
        table: has the columns.
        groups: column -> names.
    """
    added = [
        (labels == name if name != UNSEEN else ~np.isin(labels, names)).astype(float)
        for column, names in groups.items()
        for labels in [_labels(table, column, "per")[rows.number]]
        for name in (*names, UNSEEN)
    ]
    return rows._replace(inputs=np.column_stack([rows.inputs, *added]))


def _labels(table: Table, column: str, key: str) -> np.ndarray:
    if column not in table.columns:
        raise table.missing(column, f"{key} names it.")
    return table.labels(column)


def _refuse_changes(rows: Rows, labels: np.ndarray, column: str, key: str) -> None:
    changes = (labels[1:] != labels[:-1]) & (rows.episode[1:] == rows.episode[:-1])
    if changes.any():
        i = int(np.flatnonzero(changes)[0])
        raise DataError(
            f"{key}: column '{column}' changes from '{labels[i]}' to '{labels[i + 1]}' within episode "
            f"{rows.episode[i]}. A group is the same over an episode: name the episodes (data.episode), or another column."
        )
