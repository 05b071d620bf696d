"""Keys of a data YAML that say when values were measured: `latency`, `times`, `join`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from simpel_cli.errors import ConfigError, did_you_mean

JOIN_KEYS = ("path", "time", "columns", "episode")
_SECONDS = {"type": "number", "minimum": 0}
_TEXTS = {"type": "array", "items": {"type": "string"}, "minItems": 1}
LATENCY: dict[str, Any] = {  # JSON schema
    "type": "object",
    "additionalProperties": {
        "anyOf": [_SECONDS, {"type": "array", "items": _SECONDS, "minItems": 2, "maxItems": 2}],
        "description": "s, or [low, high] for discover to estimate.",
    },
}
JOIN: dict[str, Any] = {  # JSON schema
    "type": "array",
    "items": {
        "type": "object",
        "properties": {
            "path": {
                "anyOf": [{"type": "string"}, _TEXTS],
                "description": "A file, a pattern or a list, as data.path.",
            },
            "time": {"type": "string", "description": "Column of the time, s, on the clock of data.time."},
            "columns": _TEXTS | {"description": "Columns that are taken; left out: all that data.path does not have."},
            "episode": {"type": "string", "description": "Column of the names that data.episode has, too."},
        },
        "required": ["path", "time"],
        "additionalProperties": False,
    },
}


class Join(NamedTuple):
    """A table of other sensors.

    Args:
        key: its place, `data.join[0]`, for messages.
        paths: files or patterns.
        time: column of the time, s.
        columns: that are taken; None: all that the main table does not have.
        episode: column of the episode's name; None: not said.
    """

    key: str
    paths: tuple[str, ...]
    time: str
    columns: tuple[str, ...] | None
    episode: str | None


def read_latency(given: Mapping[str, Any]) -> dict[str, float | tuple[float, float]]:
    """Read `data.latency`: a number of s, or the ends of a range.

    Raises:
        ConfigError: it is negative, no number, or its ends are in the wrong order.
    """
    found: dict[str, float | tuple[float, float]] = {}
    for name, value in given.items():
        path, both = f"data.latency.{name}", isinstance(value, list | tuple)
        ends = list(value) if both else [value]
        if len(ends) != (2 if both else 1) or not all(map(_is_seconds, ends)):
            raise ConfigError(
                f"{path}: {_shown(value)} is not allowed, only a number of s, e.g. 0.012, or two, [0, 0.05], between which "
                "`simpel discover` estimates it."
            )
        if ends[0] < 0:
            raise ConfigError(
                f"{path}: {_shown(value)} s is not allowed: a value cannot be recorded before it is measured. Give 0 or more."
            )
        if both and ends[0] >= ends[1]:
            raise ConfigError(
                f"{path}: {_shown(value)} is no range: its low end is not below its high end. Write [low, high], or a "
                "number if it is known."
            )
        found[name] = (float(ends[0]), float(ends[1])) if both else float(ends[0])
    return found


def read_times(given: Mapping[str, str], time: str | None) -> None:
    """Check `data.times`.

    Args:
        given: quantity -> column.
        time: column of the time of the rows.

    Raises:
        ConfigError: an entry names no column, or the rows have no time.
    """
    for name, column in given.items():
        if not column:
            raise ConfigError(f"data.times.{name}: {column!r} is not the name of a column of times.")
        if time is None:
            raise ConfigError(
                f"data.times.{name}: the times of the rows are not known, to which those of '{column}' could be compared. Name "
                "their column: data.time: <name>."
            )


def read_join(given: Sequence[Mapping[str, Any]], time: str | None) -> tuple[Join, ...]:
    """Read `data.join`.

    Args:
        given: entries.
        time: column of the time of the main table.

    Raises:
        ConfigError: an unknown or missing key, a wrong value, or the rows have no time.
    """
    return tuple(_read_one(f"data.join[{i}]", node, time) for i, node in enumerate(given))


def _read_one(key: str, node: Mapping[str, Any], time: str | None) -> Join:
    for name in node:
        if name not in JOIN_KEYS:
            hint = did_you_mean(name, list(JOIN_KEYS))
            raise ConfigError(f"{key}.{name}: no such key, only {', '.join(JOIN_KEYS)}.{hint}")
    path = node.get("path")
    paths = tuple(path) if isinstance(path, list | tuple) else (path,)
    if not (paths and all(isinstance(each, str) and each for each in paths)):
        raise ConfigError(f"{key}.path: {path!r} is not allowed, only the name of a file or a list of names.")
    own = node.get("time")
    if not (isinstance(own, str) and own):
        raise ConfigError(
            f"{key}.time: {own!r} is not the name of a column. A table is joined by the times of its values: name their column."
        )
    columns = node.get("columns")
    if columns is not None and not (
        isinstance(columns, list | tuple) and columns and all(isinstance(each, str) and each for each in columns)
    ):
        raise ConfigError(f"{key}.columns: {columns!r} is not a list of columns, e.g. [temperature].")
    episode = node.get("episode")
    if episode is not None and not (isinstance(episode, str) and episode):
        raise ConfigError(f"{key}.episode: {episode!r} is not the name of a column.")
    if time is None:
        raise ConfigError(
            f"{key}: the times of the rows of data.path are not known, to which values of {', '.join(paths)} could belong. "
            "Name their column: data.time: <name>."
        )
    return Join(key, paths, own, None if columns is None else tuple(columns), episode)


def _is_seconds(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:g}" if _is_seconds(value) else repr(value)
