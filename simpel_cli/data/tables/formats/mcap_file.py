"""An MCAP file as columns: messages in JSON, or of ROS 2 in CDR."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from simpel_cli.data.tables.formats.optional import library
from simpel_cli.data.tables.formats.topics import Message, from_json, sheet_of_topics
from simpel_cli.data.tables.sheet import Sheet
from simpel_cli.errors import DataError, SimpelError


def read_mcap(path: Path) -> Sheet:
    """Read a .mcap file.

    Raises:
        DataError: it is damaged, or none of its messages can be decoded and has a number.
    """
    library("mcap", "mcap", path.name)
    unusable: dict[str, str] = {}
    try:
        return sheet_of_topics(path, _messages(path, unusable), unusable, ())
    except SimpelError:
        raise
    except (
        Exception
    ) as error:  # of a damaged file; the library raises its own errors, and what its parser stumbles over
        raise DataError(
            f"{path.name} is damaged, cut off or no MCAP file. Copy it again; `mcap recover` of the MCAP tools saves what is "
            "left."
        ) from error


def _messages(path: Path, unusable: dict[str, str]) -> Iterator[Message]:
    reader = library("mcap.reader", "mcap", path.name)
    ros = library("mcap_ros2.decoder", "mcap", path.name).DecoderFactory()
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages():
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(ros, schema, channel, path, unusable)
            decode = decoders[channel.id]
            if decode is not None:
                yield Message(channel.topic, message.log_time, decode(message.data))


def _decoder(
    ros: Any, schema: Any, channel: Any, path: Path, unusable: dict[str, str]
) -> Callable[[bytes], Any] | None:
    """What decodes the messages of a channel; None: nothing does, which is kept in `unusable`."""
    if channel.message_encoding == "json":
        return from_json
    why = "which is not read"
    try:
        found: Callable[[bytes], Any] | None = ros.decoder_for(channel.message_encoding, schema)
    except Exception as error:  # a schema that the library cannot parse
        found, why = None, f"whose schema is not understood ({error})"
    if found is None:
        topic = channel.topic.strip("/") or channel.topic
        kind = f"'{channel.message_encoding}'" + (
            f" with a schema in '{schema.encoding}'" if schema is not None else ""
        )
        unusable[topic] = (
            f"topic '{channel.topic}' of {path.name} is encoded as {kind}, {why}. Messages in JSON, and those of ROS 2 (cdr, "
            "ros2msg), are: record or convert it so."
        )
    return found
