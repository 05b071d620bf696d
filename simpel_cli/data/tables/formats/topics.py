"""Messages of several topics as one table: a row per time at which any topic spoke, columns `topic.field`."""

import dataclasses
import json
from array import array
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError

TIME = "time"
MOST_ENTRIES = 64  # of a list in a message; more are an image, a scan or a cloud of points


class Message(NamedTuple):
    """What one topic said once.

    Args:
        topic: its name.
        time: when it was recorded, ns.
        content: fields, as nested mappings, objects and lists.
    """

    topic: str
    time: int
    content: Any


def sheet_of_topics(
    path: Path, messages: Iterable[Message], unusable: dict[str, str], parts: tuple[Path, ...]
) -> Sheet:
    """Make a table of messages: `time` in s since the first of them, and a column per field, NaN where its topic was silent.

    Args:
        path: of the recording.
        messages: in any order.
        unusable: topics that cannot be read -> why; it may grow while `messages` is gone through.
        parts: the files that it is made of.

    Raises:
        DataError: there is no message with a number.
    """
    times: dict[str, list[int]] = {}
    values: dict[str, dict[str, dict[int, float | str]]] = {}  # topic -> field -> number of the message -> value
    for message in messages:
        name = message.topic.strip("/") or message.topic
        heard, fields = times.setdefault(name, []), values.setdefault(name, {})
        for field, value in _flat(message.content, ""):
            fields.setdefault(field or "value", {})[len(heard)] = value
        heard.append(message.time)
    every = np.unique(np.concatenate([np.array(t, np.int64) for t in times.values()] or [np.empty(0, np.int64)]))
    columns = {TIME: pa.chunked_array([pa.array((every - every[:1]) * 1e-9)])}
    repeated = {}
    for name, heard in times.items():
        row = np.searchsorted(every, np.array(heard, np.int64))
        if lost := len(row) - len(np.unique(row)):
            repeated[name] = lost
        columns |= {f"{name}.{field}": _column(entries, row, len(every)) for field, entries in values[name].items()}
    if not any(pa.types.is_floating(column.type) for name, column in columns.items() if name != TIME):
        why = " ".join(list(unusable.values())[:3])
        raise DataError(f"{path.name} has no message with a number. {why}".rstrip())
    return Sheet(path, columns, {TIME: "s"}, unusable=unusable, notes=_notes(times, repeated, unusable), parts=parts)


def from_json(data: bytes) -> Any:
    """Return the content of a JSON message.

    Raises:
        ValueError: it is none.
    """
    return json.loads(data)


def _column(entries: dict[int, float | str], row: np.ndarray, length: int) -> pa.ChunkedArray:
    """Values in the rows of their messages; of two messages at one time the later one counts."""
    if any(isinstance(value, str) for value in entries.values()):
        texts: list[str | None] = [None] * length
        for number, value in entries.items():
            texts[row[number]] = str(value)
        return pa.chunked_array([pa.array(texts, pa.string())])
    numbers = np.full(length, np.nan)
    numbers[row[list(entries)]] = list(entries.values())
    return pa.chunked_array([pa.array(numbers)])


def _flat(content: Any, name: str) -> Iterator[tuple[str, float | str]]:
    """Fields below a field, with their names; a ROS time stamp becomes s. Long lists, bytes and nulls are passed over."""
    if isinstance(content, bool | int | float | np.generic):
        yield name, float(content)
    elif isinstance(content, str):
        yield name, content
    elif content is None or isinstance(content, bytes | bytearray):
        return
    elif isinstance(content, list | tuple | np.ndarray | array):
        for i, value in enumerate(content if len(content) <= MOST_ENTRIES else ()):
            yield from _flat(value, f"{name}.{i}" if name else str(i))
    else:
        fields = _fields(content)
        if set(fields) in ({"sec", "nanosec"}, {"secs", "nsecs"}):
            seconds, nanoseconds = fields.values()
            yield name, float(seconds) + 1e-9 * float(nanoseconds)
            return
        for key, value in fields.items():
            yield from _flat(value, f"{name}.{key}" if name else str(key))


def _fields(content: Any) -> Mapping[str, Any]:
    if isinstance(content, Mapping):
        return content
    if dataclasses.is_dataclass(content):
        return {field.name: getattr(content, field.name) for field in dataclasses.fields(content)}
    return {name: getattr(content, name) for name in type(content).__slots__}  # what mcap_ros2 makes


def _notes(times: Mapping[str, Any], repeated: Mapping[str, int], unusable: Mapping[str, str]) -> tuple[str, ...]:
    notes = []
    if len(times) > 1:
        notes.append(
            f"a row per time at which one of {len(times)} topics spoke; the columns of the others are empty there"
        )
    for name, count in repeated.items():
        notes.append(f"{count} messages of {name} at the time of another one of it: the last counts")
    if unusable:
        notes.append(f"left out, not decoded: {', '.join(unusable)}")
    return tuple(notes)
