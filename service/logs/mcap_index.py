"""The little that a reader first needs of a long MCAP file, by way of its index: https://mcap.dev/spec#summary-section.

A file that was closed ends in an index: where its metadata stands, and which chunks have messages of which channel. It
is believed only if it matches its checksum, lacks nothing that the statistics beside it count, and points at what it
says; otherwise there is no short way, and the file has to be read from the front.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from mcap.reader import SeekingReader
from mcap.summary import Summary

from service.logs.mcap_records import (
    CHUNK,
    MAGIC,
    MESSAGE,
    METADATA,
    Message,
    Record,
    footer,
    inside,
    next_record,
    summary,
)

_CHECKSUM_BYTES: Final = 4
"""The last of the footer; it covers everything from the start of the index up to itself."""


def skim(path: Path, wanted: Callable[[str], bool]) -> list[Record] | None:
    """Channels, metadata, the file's first message, and every message of some topics.

    Args:
        path: The file.
        wanted: Whether a topic's messages are wanted.

    Returns:
        The records, each kind in the file's order; None if there is no index to be relied on. A damaged chunk is left
        out without a word: who reads the file's messages will hear of it.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        index = _index(file, path.stat().st_size)
        if index is None:
            return None
        ids = {channel.id for channel in index.channels.values() if wanted(channel.topic)}
        found = summary(path)
        for offset in sorted(place.offset for place in index.metadata_indexes):
            if (metadata := _record(file, METADATA, offset)) is None:
                return None
            found.append(metadata)
        first = True
        for place in sorted(index.chunk_indexes, key=lambda place: place.chunk_start_offset):
            if not first and ids.isdisjoint(place.message_index_offsets):
                continue
            if (chunk := _record(file, CHUNK, place.chunk_start_offset)) is None:
                return None
            for record in inside(chunk, []):
                if record.opcode == MESSAGE and (first or Message.read(record.content).channel in ids):
                    found.append(record)
                    first = False
        return found


def _index(file: BinaryIO, size: int) -> Summary | None:
    """The index at the end of a file, if it is whole and tells of every channel, chunk and metadata record."""
    end = footer(file, size)
    if end is None or not end.checksum:
        return None
    file.seek(end.summary_start)
    checked = file.read()[: -_CHECKSUM_BYTES - len(MAGIC)]
    if zlib.crc32(checked) != end.checksum:
        return None
    file.seek(0)
    index = SeekingReader(file).get_summary()
    if index is None or index.statistics is None:
        return None
    counts = index.statistics
    indexed = set().union(*(place.message_index_offsets for place in index.chunk_indexes))
    complete = (
        counts.chunk_count == len(index.chunk_indexes)
        and counts.metadata_count == len(index.metadata_indexes)
        and {channel for channel, count in counts.channel_message_counts.items() if count} == indexed
        and indexed <= index.channels.keys()
    )
    return index if complete else None


def _record(file: BinaryIO, opcode: int, offset: int) -> Record | None:
    """The record at a place in the file, if it is of that kind."""
    file.seek(offset)
    record = next_record(file, [])
    return record if record is not None and record.opcode == opcode else None
