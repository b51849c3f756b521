"""A log with everything in it decoded, at full rate: what viewers show, beside the raw messages that it was made from.

The recorder decodes at a bounded rate, to keep its files small. Here each message is decoded, and what the recorder had
decoded is left out. Raw messages keep their channels, schemas, times and sequence, and the log its metadata and
attachments; the files of a rotated run become one, so what each of them repeats is written once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from protocol import topics
from service.logs.decoded import Decoded, Decoder
from service.logs.files import LogFiles
from service.logs.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK_BYTES,
    MESSAGE,
    METADATA,
    SCHEMA,
    Damage,
    Message,
    Record,
    records,
    summary,
)


class Written(NamedTuple):
    """What was written, and what of the log could not be read."""

    messages: int
    topics: list[str]
    damages: dict[Path, list[Damage]]


def write_decoded(files: LogFiles, out: Path, progress: Callable[[float], None]) -> Written:
    """Write a run as one log with everything decoded.

    Args:
        files: The run.
        out: The new file; what is there is overwritten.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        OSError: It cannot be read, or not be written.
    """
    decoder = Decoder(rate_hz=None)
    for contract in files.contracts.values():
        decoder.configure(contract)
    damages: dict[Path, list[Damage]] = {}
    sizes = [path.stat().st_size for path in files.paths]
    with out.open("wb") as file:
        copy = _Copy(Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD), decoder)
        for i, path in enumerate(files.paths):
            found: list[Damage] = []
            done = sum(sizes[:i])
            copy.file(path, found, lambda read, done=done: progress((done + read) / sum(sizes)))  # type: ignore[misc]  # the default binds it
            if found:
                damages[path] = found
        copy.writer.finish()
    return Written(copy.messages, sorted(copy.topics), damages)


class _Raw(NamedTuple):
    """A channel of the new file, and what its messages are, if they can be decoded."""

    id: int
    address: topics.Address | None


class _Copy:
    """Writes the records of one file after another, with ids of its own, and what they give decoded."""

    def __init__(self, writer: Writer, decoder: Decoder) -> None:
        self.writer = writer
        self.messages = 0
        self.topics: set[str] = set()
        self._decoder = decoder
        self._known: dict[Hashable, int] = {}  # schemas and channels of the new file, by what they are
        self._told: set[Hashable] = set()  # metadata and attachments in it
        self._schemas: dict[int, int] = {}  # of the file that is read, by its ids
        self._channels: dict[int, _Raw | None] = {}
        writer.start(profile="aeroloop", library="aeroloop log export")

    def file(self, path: Path, damages: list[Damage], progress: Callable[[int], None]) -> None:
        """Write what a file holds."""
        self._schemas, self._channels = {0: 0}, {}
        for record in chain(summary(path), records(path, damages, progress)):
            try:
                if record.opcode == MESSAGE:
                    self._message(Message.read(record.content))
                else:
                    self._other(record)
            except (struct.error, UnicodeDecodeError, ValueError, EOFError) as error:
                damages.append(Damage(record.offset, f"a record cannot be read: {error}"))

    def _message(self, message: Message) -> None:
        channel = self._channels.get(message.channel)
        if channel is None:
            return
        self.writer.add_message(channel.id, message.log_time, message.data, message.publish_time, message.sequence)
        self.messages += 1
        if channel.address is not None:
            for decoded in self._decoder.take(channel.address, message.data, message.publish_time):
                self._show(decoded)

    def _show(self, decoded: Decoded) -> None:
        """As the recorder does it: its log time is the publication of what it was made from."""
        shape = decoded.shape
        schema = self._schema(shape.name, shape.encoding, shape.schema)
        channel = self._channel(decoded.topic, shape.message_encoding, schema)
        self.writer.add_message(channel, decoded.at_ns, decoded.data, decoded.at_ns)
        self.messages += 1

    def _other(self, record: Record) -> None:
        stream = ReadDataStream(BytesIO(record.content))
        if record.opcode == SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = self._schema(schema.name, schema.encoding, schema.data)
        elif record.opcode == CHANNEL:
            channel = Channel.read(stream)
            if channel.id not in self._channels:
                self._channels[channel.id] = self._raw(channel)
        elif record.opcode == METADATA:
            metadata = Metadata.read(stream)
            if self._first(METADATA, record.content):
                self.writer.add_metadata(metadata.name, metadata.metadata)
        elif record.opcode == ATTACHMENT:
            told = Attachment.read(stream)
            if self._first(ATTACHMENT, told.name, told.data):
                self.writer.add_attachment(told.create_time, told.log_time, told.name, told.media_type, told.data)

    def _raw(self, channel: Channel) -> _Raw | None:
        """None for what the recorder decoded: our decoder's topics begin with a slash, as no key can."""
        if channel.topic.startswith("/"):
            return None
        schema = self._schemas.get(channel.schema_id, 0)
        return _Raw(
            self._channel(channel.topic, channel.message_encoding, schema, channel.metadata),
            topics.read_key(channel.topic),
        )

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        what = SCHEMA, name, encoding, data
        if what not in self._known:
            self._known[what] = self.writer.register_schema(name, encoding, data)
        return self._known[what]

    def _channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str] | None = None) -> int:
        what = CHANNEL, topic, encoding, schema
        if what not in self._known:
            self._known[what] = self.writer.register_channel(topic, encoding, schema, metadata or {})
            self.topics.add(topic)
        return self._known[what]

    def _first(self, *what: Hashable) -> bool:
        """Whether this is told for the first time."""
        known = len(self._told)
        self._told.add(what)
        return len(self._told) > known
