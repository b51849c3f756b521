"""Log file: one MCAP file with raw messages on a channel per key, decoded ones beside them, and all a reader needs.

Messages are collected in a chunk in memory. A closed chunk is compressed and written whole: a failed write is undone,
and the chunk stays in memory for the next try, so a full disk never leaves half a record behind.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Final

from mcap.writer import Writer

from aeroloop.protocol.messages import topics
from aeroloop.protocol.runtime.host import versions
from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.logs.mcap_file import CHUNK_BYTES, DESCRIPTION_METADATA, with_checksum
from aeroloop.service.viewers.schemas import Decoded, Shape, json_shape

TRACE_ENCODING: Final = "x-aeroloop-trace"

_NO_LIMIT: Final = 1 << 60
"""A chunk size [bytes] that none reaches: `LogFile.commit` alone closes chunks."""
_MESSAGE_HEAD: Final = 31
"""Bytes of a message record in front of its data."""
_32_BITS: Final = 0xFFFF_FFFF


class LogFile:
    """An MCAP file that is being written to a new path. Raises OSError if it exists already or cannot be created.

    It is the stream that its own writer writes to; `size` is its bytes on the disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._channels: dict[str, int] = {}
        self._shapes: dict[Shape, int] = {}
        self._gathered = 0  # bytes of messages in the open chunk
        self._writer = Writer(self, chunk_size=_NO_LIMIT, enable_data_crcs=True)  # type: ignore[arg-type]  # as a stream
        self._writer.start(profile="aeroloop", library=f"aeroloop {versions()['aeroloop']}")

    def write(self, data: bytes) -> int:
        """Add bytes to those that `flush` writes."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Where the next bytes will stand."""
        return self.size + len(self._pending)

    def flush(self) -> None:
        """Write the pending bytes through to the disk, or leave the file as it was and raise OSError."""
        if not self._pending:
            return
        try:
            with memoryview(self._pending) as pending:
                written = 0
                while written < len(pending):
                    written += os.pwrite(self._file.fileno(), pending[written:], self.size + written)
            os.fdatasync(self._file.fileno())
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.size)
            raise
        self.size += len(self._pending)
        self._pending.clear()

    @property
    def full(self) -> bool:
        """Whether the chunk has reached its size."""
        return self._gathered >= CHUNK_BYTES

    @property
    def replaced(self) -> bool:
        """Whether the file was moved or removed while it was written."""
        with suppress(OSError):
            return not os.path.samestat(self.path.stat(), os.fstat(self._file.fileno()))
        return True

    def add(self, received: Delivery, at_ns: int, decoded: Iterable[Decoded] = ()) -> None:
        """Add a message, received at `at_ns` [ns since 1970], to the chunk, and its decoded ones, each under its topic.

        `at_ns` is also its publish time where it carries none; the log time of decoded ones is its publish time.
        """
        channel = self._channel(received.key, None)
        published_ns = at_ns if received.published_ns is None else max(0, received.published_ns)
        self._add(channel, at_ns, published_ns, received.payload, received.number & _32_BITS)
        for one in decoded:
            self._add(self._channel(one.topic, one.shape), one.at_ns, one.at_ns, one.data, 0)

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Add a metadata record, under a checksum."""
        self._writer.add_metadata(name, with_checksum(name, entries))

    def add_description(self, key: str, payload: bytes) -> None:
        """Add a role's last description as metadata."""
        self.add_metadata(DESCRIPTION_METADATA, {"key": key, "json": payload.decode()})

    def attach_specification(self, at_ns: int) -> None:
        """Attach the wire's specification, which a reader of frames needs."""
        text = files("aeroloop.protocol").joinpath("SPEC.md").read_bytes()
        self._writer.add_attachment(at_ns, at_ns, "protocol/SPEC.md", "text/markdown", text)

    def commit(self) -> None:
        """Close the chunk and write it. Raises OSError; then it is written with the next."""
        self._gathered = 0
        self._writer.flush()

    def end(self) -> None:
        """Write the last chunk and the index, and close the file. After an OSError only `abandon` is allowed."""
        self._writer.finish()
        self.flush()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is on the disk; drop what is not written."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and remove it."""
        self.abandon()
        with suppress(OSError):
            self.path.unlink()

    def _add(self, channel: int, log_time: int, publish_time: int, data: bytes, sequence: int) -> None:
        self._writer.add_message(channel, log_time, data, publish_time, sequence)
        self._gathered += _MESSAGE_HEAD + len(data)

    def _channel(self, topic: str, shape: Shape | None) -> int:
        """Id of a topic's channel; a key has the shape of its raw messages."""
        if (known := self._channels.get(topic)) is not None:
            return known
        if shape is None and (address := topics.read_key(topic)):
            shape = _raw_shape(address.topic)
        if shape is not None and shape not in self._shapes:
            self._shapes[shape] = self._writer.register_schema(shape.name, shape.encoding, shape.schema)
        encoding, schema = (shape.message_encoding, self._shapes[shape]) if shape else ("application/octet-stream", 0)
        channel = self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        return channel


def _raw_shape(topic: topics.Topic) -> Shape | None:
    if topic.kind == "trace":
        text = "batch of rows: section 10 of the attachment protocol/SPEC.md; its frames by the plant's description"
        return Shape("aeroloop.Trace", TRACE_ENCODING, text.encode(), TRACE_ENCODING)
    return json_shape(f"aeroloop.{topic.title}", topic.model) if topic.model is not None else None
