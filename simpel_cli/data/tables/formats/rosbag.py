"""A rosbag2 as columns: its folder, or one of its files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from simpel_cli.data.tables.formats.optional import library
from simpel_cli.data.tables.formats.topics import Message, sheet_of_topics
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError, SimpelError


def read_rosbag(path: Path) -> Sheet:
    """Read a rosbag2.

    Args:
        path: of the folder with `metadata.yaml`, or of a .db3 file.

    Raises:
        DataError: it is damaged, or none of its messages can be decoded and has a number.
    """
    library("rosbags", "rosbag", path.name)
    unusable: dict[str, str] = {}
    inside = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else []
    parts = tuple(sorted(inside, key=lambda file: (file.suffix == ".yaml", file.name)))  # the messages first
    try:
        return sheet_of_topics(path, _messages(path, unusable), unusable, parts)
    except SimpelError:
        raise
    except Exception as error:  # of a damaged file; the library raises its own errors, and those of SQLite, YAML, ...
        said = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise DataError(
            f"{path.name} is damaged, cut off or no rosbag2 ({said}). "
            "Copy it again, with metadata.yaml; `ros2 bag reindex` writes that anew."
        ) from error


def _messages(path: Path, unusable: dict[str, str]) -> Iterator[Message]:
    anyreader = library("rosbags.highlevel", "rosbag", path.name).AnyReader
    types = library("rosbags.typesys", "rosbag", path.name)
    with anyreader([path], default_typestore=types.get_typestore(types.Stores.LATEST)) as reader:
        for connection, time, data in reader.messages():
            topic = connection.topic.strip("/") or connection.topic
            if topic in unusable:
                continue
            try:
                content: Any = reader.deserialize(data, connection.msgtype)
            except Exception as error:  # a type that the bag does not define, or a message that does not fit it
                unusable[topic] = (
                    f"topic '{connection.topic}' of {path.name} has messages of {connection.msgtype}, which cannot be decoded "
                    f"({error}). Record the bag with its message definitions (mcap), or publish numbers in a standard type."
                )
                continue
            yield Message(connection.topic, time, content)
