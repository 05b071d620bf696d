"""Which rows are for training and which for testing."""

import numpy as np

from simpel_cli.data.config import SPLIT_DEFAULT, Measurements
from simpel_cli.data.recording import Check, stream
from simpel_cli.data.rows import Rows, split_labels
from simpel_cli.data.tables.table import Table
from simpel_cli.errors import DataError

PARTS = ("train", "test")


def assign(config: Measurements, table: Table, rows: Rows, dynamic: bool, seed: int) -> tuple[Check, Rows]:
    """Label every row train, test or something else.

    Args:
        config: `split`, `n_episodes`.
        table: the file, for a split column.
        rows: of the file.
        dynamic: the rows of an episode follow each other, so that neighbours must not be split at random.
        seed: of the choice of test episodes.

    Raises:
        DataError: no train or no test rows, a split column that alternates within an episode, or too few episodes.
    """
    detail = ""
    if "column" in config.split:
        label = split_labels(config, table, config.split["column"])[rows.number]
        _refuse_alternation(config.split["column"], rows, label, dynamic)
        if "test" in config.split:
            named = np.isin(label, list(config.split["test"]))
            label = np.where(named, "test", np.where(label == "test", "unused", label))
    elif config.all_train:
        label = np.full(len(rows.episode), "train")
        detail = "everything is trained on, nothing is kept to test on"
    else:
        rule = SPLIT_DEFAULT | dict(config.split)
        fraction = float(rule["test_fraction"])
        if rule["by"] == "time":
            label = _by_time(rows, fraction)
        elif _is_one_bag_of_rows(config, rows):
            label = _by_row(rows, fraction, seed)
            n_test = int(np.sum(label == "test"))
            detail = (
                f"one episode of a simulator without states, whose rows do not depend on each other: {n_test} of "
                f"{len(label)} rows, drawn at random (seed {seed}), are the test"
            )
        else:
            label = _by_episode(rows, fraction, seed)
    left_out = int(np.sum(~np.isin(label, PARTS)))
    others = ", ".join(repr(str(v)) for v in np.unique(label) if v not in PARTS)
    for part in PARTS[: 1 if config.all_train else 2]:
        if not np.any(label == part):
            found = f" The split column has only {', '.join(repr(str(v)) for v in np.unique(label))}." if others else ""
            raise DataError(f"the {part} split is empty.{found} Values for use are 'train' and 'test' (data.split).")
    label = _first_episodes(config.n_episodes, rows, label)
    counts = [len(np.unique(rows.episode[label == part])) for part in PARTS]
    detail = detail or f"train rows from {counts[0]} and test rows from {counts[1]} episodes"
    if left_out:
        detail += f"; {left_out} rows marked {others} left out"
    return Check("split", True, detail), rows._replace(split=label)


def _by_episode(rows: Rows, fraction: float, seed: int) -> np.ndarray:
    episodes = np.unique(rows.episode)
    if len(episodes) < 2:
        raise DataError(
            "data.split: there is one episode only, which cannot be both train and test. Use its end as the test: "
            "`split: {test_fraction: 0.25, by: time}`; or name the column of the episodes: data.episode."
        )
    n_test = min(max(1, round(fraction * len(episodes))), len(episodes) - 1)
    chosen = stream(seed, "split").permutation(episodes)[:n_test]
    return np.where(np.isin(rows.episode, chosen), "test", "train")


def _is_one_bag_of_rows(config: Measurements, rows: Rows) -> bool:
    """One episode only, and no row of it needs another: no states, no past inputs, no filter over rows."""
    static = rows.states.shape[1] == 0 and config.stack_actions == 0 and config.resample is None
    return static and len(np.unique(rows.episode)) == 1


def _by_row(rows: Rows, fraction: float, seed: int) -> np.ndarray:
    n = len(rows.episode)
    if n < 2:
        raise DataError("data.split: there is one row only, which cannot be both train and test.")
    chosen = stream(seed, "split").permutation(n)[: min(max(1, round(fraction * n)), n - 1)]
    return np.where(np.isin(np.arange(n), chosen), "test", "train")


def _by_time(rows: Rows, fraction: float) -> np.ndarray:
    """The end of every episode is its test; nothing is drawn, so that no seed has a part in it."""
    _, code = np.unique(rows.episode, return_inverse=True)
    last = np.zeros(code.max() + 1, dtype=int)
    np.maximum.at(last, code, rows.position)
    return np.where(rows.position >= np.ceil((1 - fraction) * (last[code] + 1)), "test", "train")


def _refuse_alternation(column: str, rows: Rows, label: np.ndarray, dynamic: bool) -> None:
    if not dynamic:
        return
    changes = (label[1:] != label[:-1]) & (rows.episode[1:] == rows.episode[:-1])
    for episode in np.unique(rows.episode[1:][changes]):
        inside = rows.episode == episode
        n_changes = int(np.sum(changes & inside[1:]))
        if n_changes >= len(np.unique(label[inside])):
            raise DataError(
                f"data.split.column: '{column}' changes {n_changes} times within episode {episode}, so that "
                "neighbouring rows are both trained on and tested on. Split by whole episodes, or "
                "`split: {test_fraction: 0.25, by: time}`."
            )


def _first_episodes(n_episodes: int | None, rows: Rows, label: np.ndarray) -> np.ndarray:
    if n_episodes is None:
        return label
    train = label == "train"
    names, first = np.unique(rows.episode[train], return_index=True)
    if n_episodes > len(names):
        raise DataError(f"data.n_episodes: {n_episodes} training episodes are asked for, the data have {len(names)}.")
    kept = names[np.argsort(first)][:n_episodes]
    return np.where(train & ~np.isin(rows.episode, kept), "unused", label)
