"""MCAP files whose messages are JSON, as Foxglove's own schemas are: the face of a bag of :mod:`rosbags` round them.

Messages are those of ``foxglove.LocationFix``, and ROS' types written as JSON; ROS 2 messages in an MCAP (CDR) are
rosbags' to read.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from dlkf.data.readers.formats import library

MAGIC = b"\x89MCAP0\r\n"


class Connection(NamedTuple):
    """A channel."""

    topic: str
    msgtype: str


class JsonBag:
    """The topics and messages of an MCAP file of JSON."""

    def __init__(self, path: Path) -> None:
        self.path, self.reading = path, library("mcap.reader", "an MCAP file")
        self.connections = [Connection(topic, kind) for topic, kind, encoding in _channels(path) if encoding == "json"]

    def messages(self, connections: list[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Channel, time of the log [ns] and bytes of every message."""
        by_topic = {c.topic: c for c in connections}
        with self.path.open("rb") as stream:
            reader = self.reading.make_reader(stream)
            for _, channel, message in reader.iter_messages(topics=list(by_topic)):
                yield by_topic[channel.topic], message.log_time, message.data

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """A message with attributes as ROS' have; Foxglove's ``timestamp`` is a header's stamp."""
        message = json.loads(raw, object_hook=lambda fields: SimpleNamespace(**fields))
        if isinstance(stamp := getattr(message, "timestamp", None), SimpleNamespace) and not hasattr(message, "header"):
            own = SimpleNamespace(sec=getattr(stamp, "sec", 0), nanosec=getattr(stamp, "nsec", 0))
            message.header = SimpleNamespace(stamp=own)
        return message


def is_json(path: Path) -> bool:
    """Whether a file is an MCAP of which some channel is JSON."""
    with path.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return False
    return any(encoding == "json" for _, _, encoding in _channels(path))


def _channels(path: Path) -> list[tuple[str, str, str]]:
    """Topic, schema and encoding of the channels of a file."""
    errors = library("mcap.exceptions", "an MCAP file")
    try:
        with path.open("rb") as stream:
            summary = library("mcap.reader", "an MCAP file").make_reader(stream).get_summary()
    except (errors.McapError, errors.EndOfFile, ValueError, struct.error):  # cut off, as rosbags says
        return []
    if summary is None:
        return []
    kinds = {number: schema.name for number, schema in summary.schemas.items()}
    return [(c.topic, kinds.get(c.schema_id, ""), c.message_encoding) for c in summary.channels.values()]
