"""The columns of a file under the simulator's names and in its order, before anything is cut or resampled."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Source
from simpel_cli.data.tables.table import Table
from simpel_cli.data.timing.joined_tables import Joined
from simpel_cli.errors import DataError
from simulators.model import Model


class Rows(NamedTuple):
    """Rows of a file, episode by episode; within an episode in the order of the file."""

    number: np.ndarray  # (n,) row in the file, from 0
    position: np.ndarray  # (n,) row within the episode, from 0; a jump tells that rows were dropped
    episode: np.ndarray  # (n,) name
    split: np.ndarray  # (n,) train, test or anything else
    time: np.ndarray  # (n,) s
    states: np.ndarray  # (n, n_states), NaN in the columns of states that were not measured
    inputs: np.ndarray  # (n, n_inputs)
    outputs: np.ndarray  # (n, n_measured_outputs)
    next_states: np.ndarray  # (n, n_states) in layout transitions, else (n, 0)
    # (n, n_states + n_measured_outputs) s, how long before its row a value was measured; (n, 0): none was
    late: np.ndarray
    # (n, n_states + n_measured_outputs) -1, 1: the quantity lies at its sensor's low or high end, or beyond, else 0; (n, 0): no
    # sensor was declared
    beyond: np.ndarray

    def take(self, chosen: np.ndarray) -> "Rows":
        """Rows chosen by a mask or by indices."""
        return Rows(*(column[chosen] for column in self))


class Mapping(NamedTuple):
    """Which column holds which quantity."""

    columns: dict[str, str]  # measured quantity -> column
    outputs: tuple[str, ...]  # measured outputs
    unmeasured: tuple[str, ...]  # states
    joined: dict[str, int] = {}  # noqa: RUF012  measured quantity -> which of the joined tables has its column


def map_columns(config: Measurements, model: Source, table: Table, joined: Sequence[Joined] = ()) -> Mapping:
    """Find the column of every quantity.

    An output without a column is left out; a state can be declared as not measured; inputs must be there.

    Args:
        config: the data YAML.
        model: its quantities.
        table: of `data.path`.
        joined: tables of other sensors; a column that one of them names is taken from there.

    Raises:
        DataError: a column is missing, an input is declared as not measured, or nothing is measured.
    """
    states, inputs, outputs = ([q.name for q in group] for group in (model.states, model.inputs, model.outputs))
    known = model.covariates if isinstance(model, Model) else {}
    home = {column: i for i, other in enumerate(joined) for column in other.columns}
    columns: dict[str, str] = {}
    elsewhere: dict[str, int] = {}
    for name in [*states, *inputs, *outputs]:
        column = config.columns.get(name, known.get(name, name))
        if column is None and name in inputs:
            raise DataError(
                f"data.columns.{name}: an input cannot be estimated, it must be measured. "
                f"Name its column: `columns: {{{name}: <name>}}`."
            )
        if column in home and (name not in inputs or column not in table.columns):
            if name in inputs:
                raise _input_elsewhere(name, column, joined[home[column]], table)
            columns[name], elsewhere[name] = column, home[column]
            continue
        if column is None or (name in outputs and name not in config.columns and column not in table.columns):
            continue
        if column not in table.columns:
            if name in known:
                cure = f"sim.parameters.{name}.column names it; if it has another name here, say `columns: {{{name}: <name>}}`."
            elif name in inputs:
                cure = f"If it has another name, say `columns: {{{name}: <name>}}`."
            else:
                cure = (
                    f"If it was not measured, say `columns: {{{name}: null}}`; "
                    f"if it has another name, `columns: {{{name}: <name>}}`."
                )
            raise table.missing(column, cure)
        columns[name] = column
    measured_outputs = tuple(name for name in outputs if name in columns)
    unmeasured = tuple(name for name in states if name not in columns)
    if not measured_outputs and len(unmeasured) == len(states):
        raise DataError(
            f"nothing of {table.name} is measured: no column for any of {', '.join([*states, *outputs])}. "
            f"Say `columns: {{{[*states, *outputs, 'name'][0]}: <name>}}`."
        )
    return Mapping(columns, measured_outputs, unmeasured, elsewhere)


def _input_elsewhere(name: str, column: str, joined: Joined, table: Table) -> DataError:
    return DataError(
        f"column '{column}' of the input {name} is in {joined.table.name} ({joined.key}), but what the inputs are has to be "
        f"known in every row. Make that table the main one (data.path) and join {table.name}."
    )


def arrange(config: Measurements, model: Source, table: Table, mapping: Mapping) -> Rows:
    """Bring the columns of a file into the simulator's order, rows sorted by episode (in order of appearance).

    `split` stays empty here.

    Raises:
        DataError: a column is missing or holds text where numbers should be.
    """
    n = len(table)
    episode = _episodes(config, table)
    order, position = _by_episode(episode)
    names = [q.name for q in model.states]
    following = [_following(table, mapping, name) for name in names] if config.layout == "transitions" else []
    return Rows(
        number=np.arange(n),
        position=position,
        episode=episode,
        split=np.full(n, ""),
        time=_time(config, model, table, position),
        states=_stack(n, [_numbers(table, mapping, name) for name in names]),
        inputs=_stack(n, [_numbers(table, mapping, q.name) for q in model.inputs]),
        outputs=_stack(n, [_numbers(table, mapping, name) for name in mapping.outputs]),
        next_states=_stack(n, following),
        late=np.empty((n, 0)),
        beyond=np.empty((n, 0)),
    ).take(order)


def named_episodes(config: Measurements, table: Table, rows: Rows) -> np.ndarray | None:
    """Name that the file gives the episode of every row, (n,) text; None: it gives none."""
    return None if config.episode is None else _labels(table, config.episode, "data.episode")[rows.number]


def split_labels(config: Measurements, table: Table, column: str) -> np.ndarray:
    """Column that says of every row of the file whether it is train or test, (n,) text."""
    return _labels(table, column, "data.split.column")


def _episodes(config: Measurements, table: Table) -> np.ndarray:
    """Name of every row's episode, (n,) text; no episode runs on from one file into another."""
    n, file = len(table), table.file
    if config.episode is None:
        if config.layout == "transitions" and config.split.get("by") != "time":
            # rows do not follow each other, so that each can go to train or test on its own
            return np.arange(n).astype(str)
        return np.array(table.stems)[file] if len(table.sheets) > 1 else np.full(n, "0")
    label = _labels(table, config.episode, "data.episode")
    pairs = {(name, i) for name, i in zip(label.tolist(), file.tolist(), strict=True) if name}
    if len(pairs) == len({name for name, _ in pairs}):
        return label
    prefixed = np.char.add(np.char.add(np.array(table.stems)[file], ":"), label)
    return np.where(label == "", "", prefixed)


def _labels(table: Table, column: str, key: str) -> np.ndarray:
    if column not in table.columns:
        raise table.missing(column, f"Name the right column in {key}.")
    return table.labels(column)


def _time(config: Measurements, model: Source, table: Table, position: np.ndarray) -> np.ndarray:
    if config.time is None:
        return position * model.dt
    if config.time not in table.columns:
        raise table.missing(
            config.time, "Name the right column in data.time, or leave it out: then a row is one sim.dt."
        )
    return table.numbers(config.time)


def _by_episode(episode: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order of rows that makes episodes contiguous, and the position of every row (in file order) in its episode."""
    _, first, code = np.unique(episode, return_index=True, return_inverse=True)
    appearance = first[code]  # sorting by first appearance keeps the order of the episodes in the file
    order = np.argsort(appearance, kind="stable")
    starts = np.flatnonzero(np.diff(appearance[order], prepend=-1))
    run = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    position = np.empty(len(order), dtype=int)
    position[order] = run
    return order, position


def _numbers(table: Table, mapping: Mapping, name: str) -> np.ndarray:
    column = None if name in mapping.joined else mapping.columns.get(name)
    return table.numbers(column) if column is not None else np.full(len(table), np.nan)


def _following(table: Table, mapping: Mapping, name: str) -> np.ndarray:
    if name not in mapping.columns:
        raise DataError(
            f"data.columns.{name}: a state that was not measured cannot be estimated in layout 'transitions', "
            "whose rows do not follow each other. Give its column, or store trajectories."
        )
    column = f"next_{mapping.columns[name]}"
    if column not in table.columns:
        raise table.missing(
            column, "Layout 'transitions' needs the next value of every state; else data.layout: trajectories."
        )
    return table.numbers(column)


def _stack(n: int, columns: list[np.ndarray]) -> np.ndarray:
    return np.stack(columns, axis=1) if columns else np.empty((n, 0))


def same_episode(rows: Rows) -> np.ndarray:
    """Mask (n-1,): row i+1 is of the same episode."""
    return rows.episode[1:] == rows.episode[:-1]


def follows(rows: Rows) -> np.ndarray:
    """Mask (n-1,): row i+1 is the next row of the same episode, none was dropped between."""
    return same_episode(rows) & (np.diff(rows.position) == 1)
