"""One MCAP log while it is written: a channel per key with raw messages, decoded channels beside them.

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

_TRACE: Final = Shape(
    "aeroloop.Trace",
    "x-aeroloop-trace",
    b"batch of rows: section 10 of the attachment protocol/SPEC.md; its frames by the plant's description",
    "x-aeroloop-trace",
)


class LogFile:
    """A new MCAP file. Raises OSError if it exists already or cannot be created.

    It is the stream that its own writer writes to; `size` is its bytes on the disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()  # closed chunks and other records that are not yet on the disk
        self._channels: dict[str, int] = {}
        self._schemas: dict[Shape | None, int] = {None: 0}
        self._writer = Writer(self, chunk_size=CHUNK_BYTES, enable_data_crcs=True)  # type: ignore[arg-type]  # a stream
        self._writer.start(profile="aeroloop", library=f"aeroloop {versions()['aeroloop']}")

    # ── the writer's stream ──

    def write(self, data: bytes) -> int:
        """Add bytes to those that `flush` writes."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Where the next bytes will stand."""
        return self.size + len(self._pending)

    def flush(self) -> None:
        """Write the pending bytes through to the disk, or leave the file as it was and raise OSError."""
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

    # ── content ──

    def add(self, received: Delivery, at_ns: int, decoded: Iterable[Decoded] = ()) -> bool:
        """Add a message that was received at `at_ns` [ns since 1970], and its decoded ones, each at its own time.

        Returns:
            Whether a chunk is full and waits for `commit`.
        """
        if (channel := self._channels.get(received.key)) is None:
            topic = address.topic if (address := topics.read_key(received.key)) else None
            shape = json_shape(topic.model) if topic and topic.model else None
            channel = self._channel(received.key, _TRACE if topic and topic.kind == "trace" else shape)
        number = received.number & 0xFFFF_FFFF
        self._writer.add_message(channel, at_ns, received.payload, received.published_ns, number)
        for one in decoded:
            self._writer.add_message(self._channel(one.topic, one.shape), one.at_ns, one.data, one.at_ns)
        return len(self._pending) > 0

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

    def _channel(self, topic: str, shape: Shape | None) -> int:
        if topic not in self._channels:
            if shape is not None and shape not in self._schemas:
                self._schemas[shape] = self._writer.register_schema(shape.name, shape.encoding, shape.schema)
            encoding = shape.message_encoding if shape else "application/octet-stream"
            self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[shape])
        return self._channels[topic]

    # ── the disk ──

    @property
    def removed(self) -> bool:
        """Whether the file has no name any more, or is closed."""
        return self._file.closed or os.fstat(self._file.fileno()).st_nlink == 0

    @property
    def replaced(self) -> bool:
        """Whether the file was moved or removed while it was written."""
        with suppress(OSError):
            return self.removed or not os.path.samestat(self.path.stat(), os.fstat(self._file.fileno()))
        return True

    def commit(self) -> None:
        """Close the chunk and write it. Raises OSError; then it is written with the next."""
        self._writer.flush()

    def end(self) -> None:
        """Write the last chunk and the index, and close the file. After an OSError only `abandon` is allowed."""
        self._writer.finish()
        self.flush()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is on the disk; drop what is not written."""
        self._file.close()
