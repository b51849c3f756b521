"""An MCAP file, written by chunks: https://mcap.dev/spec. For a recorder that writes a thousand messages a second.

mcap's own writer spends some 10 µs of a core on each message and its entry in the index, field by field; here each is
one `struct.pack`. All other records, which are few, are mcap's. Nothing is written by itself: whoever owns the stream
decides when a chunk is closed.
"""

from __future__ import annotations

import struct
import sys
import zlib
from array import array
from typing import Final, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from service.logs.mcap_records import MAGIC

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_REST: Final = _MESSAGE.size - 9  # what its length counts, without the data
_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")
_FOOTER_SIZE: Final = 20


class Stream(Protocol):
    """Where a file goes."""

    def write(self, data: bytes, /) -> int:
        """Append bytes."""

    def tell(self) -> int:
        """Bytes so far."""


class McapWriter:
    """Writes one file.

    Args:
        stream: Where; nothing has been written to it.
        library: Who writes.

    Attributes:
        gathered: Bytes in the open chunk.
    """

    def __init__(self, stream: Stream, library: str) -> None:
        self.gathered = 0
        self._stream = stream
        self._compress = zstandard.ZstdCompressor().compress
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: array[int] = array("Q", [0])  # messages by channel; ids begin at 1
        self._parts: list[bytes] = []  # of the open chunk
        self._index: dict[int, array[int]] = {}  # log time and offset of its messages, by channel
        self._first, self._last = 1 << 64, 0  # log times in it
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        stream.write(MAGIC)
        stream.write(_bytes(Header("aeroloop", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its id."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data))
        self._gather(_bytes(self._schemas[-1]))
        return self._schemas[-1].id

    def register_channel(self, topic: str, message_encoding: str, schema: int) -> int:
        """Add a channel and return its id; schema 0 is none."""
        identifier = len(self._channels) + 1
        self._channels.append(Channel(identifier, topic, message_encoding, {}, schema))
        self._counts.append(0)
        self._gather(_bytes(self._channels[-1]))
        return identifier

    def add_message(self, channel: int, log_time: int, publish_time: int, data: bytes, sequence: int = 0) -> None:
        """Add a message to the open chunk. Times in ns since 1970."""
        index = self._index.get(channel)
        if index is None:
            index = self._index[channel] = array("Q")
        index.append(log_time)
        index.append(self.gathered)
        self._parts.append(
            _MESSAGE.pack(
                Opcode.MESSAGE,
                _MESSAGE_REST + len(data),
                channel,
                sequence & 0xFFFF_FFFF,
                log_time,
                publish_time,
            )
        )
        self._parts.append(data)
        self.gathered += _MESSAGE.size + len(data)
        if log_time < self._first:
            self._first = log_time
        if log_time > self._last:
            self._last = log_time

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Add a metadata record, outside of any chunk."""
        offset, record = self._stream.tell(), _bytes(Metadata(name=name, metadata=entries))
        self._stream.write(record)
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def add_attachment(self, at_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file, outside of any chunk."""
        offset = self._stream.tell()
        record = _bytes(Attachment(create_time=at_ns, log_time=at_ns, name=name, media_type=media_type, data=data))
        self._stream.write(record)
        self._attachments.append(AttachmentIndex(offset, len(record), at_ns, at_ns, len(data), name, media_type))

    def close_chunk(self) -> None:
        """Write the open chunk with its index, if there is a message in it."""
        if not self._index:
            return
        plain = b"".join(self._parts)
        packed = self._compress(plain)
        start = self._stream.tell()
        chunk = _bytes(Chunk("zstd", packed, self._last, self._first, zlib.crc32(plain), len(plain)))
        self._stream.write(chunk)
        offsets: dict[int, int] = {}
        index_start = self._stream.tell()
        for channel, index in self._index.items():
            offsets[channel] = self._stream.tell()
            self._counts[channel] += len(index) // 2
            if sys.byteorder == "big":
                index.byteswap()
            entries = index.tobytes()
            self._stream.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries)
        self._chunks.append(
            ChunkIndex(
                message_start_time=self._first,
                message_end_time=self._last,
                chunk_start_offset=start,
                chunk_length=len(chunk),
                message_index_offsets=offsets,
                message_index_length=self._stream.tell() - index_start,
                compression="zstd",
                compressed_size=len(packed),
                uncompressed_size=len(plain),
            )
        )
        self._parts.clear()
        self._index.clear()
        self.gathered, self._first, self._last = 0, 1 << 64, 0

    def finish(self) -> None:
        """Close the chunk and write the summary. Nothing more can be added."""
        self.close_chunk()
        self._stream.write(_bytes(DataEnd(data_section_crc=0)))
        start = self._stream.tell()
        summary, groups = bytearray(), []
        for opcode, records in (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ):
            group_start = len(summary)
            for record in records:
                summary += _bytes(record)
            if records:
                groups.append(SummaryOffset(opcode, start + group_start, len(summary) - group_start))
        offsets_start = start + len(summary)
        for group in groups:
            summary += _bytes(group)
        checksum = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, _FOOTER_SIZE, start, offsets_start), zlib.crc32(summary))
        self._stream.write(bytes(summary))
        self._stream.write(_bytes(Footer(start, offsets_start, checksum)))
        self._stream.write(MAGIC)

    def _gather(self, record: bytes) -> None:
        self._parts.append(record)
        self.gathered += len(record)

    def _statistics(self) -> Statistics:
        counts = {channel.id: self._counts[channel.id] for channel in self._channels}
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()
    return written
