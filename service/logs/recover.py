"""Recovery of a broken log: every whole record is copied into a new log with an index, and what was lost is named.

The copy has its own ids. Messages keep their topic, schema, times and sequence. Repetitions are written once: schemas,
channels, attachments, and a metadata record that equals the last one of its name and key.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer
from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.mcap_file import CHUNK_BYTES, DESCRIPTION_METADATA, Damage, NotMcapError, records
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress


class RecoverError(AeroloopError):
    """Nothing can be recovered; one line with the reason."""


class Recovery(BaseModel, frozen=True):
    """What was recovered."""

    out: str
    messages: int
    channels: int
    lost: list[str] = Field(description="what could not be read, a line each; empty if the file was whole")


def recover(broken: Path, out: Path, progress: Progress | None = None, *, force: bool = False) -> Recovery:
    """Write all that can be read of a log into a new file; `force` replaces an existing one that is no log.

    Raises:
        OutputError: The new file must not be written, or cannot.
        RecoverError: It is not an MCAP file, or cannot be read.
    """
    damages: list[Damage] = []
    try:
        size = broken.stat().st_size
        with writing(out, [broken], force=force) as part, part.open("xb") as new:
            copy = McapCopy(new, "aeroloop log recover")
            copy.file(broken, damages, lambda read: progress(read / size) if progress else None)
            if not copy.messages:
                raise RecoverError(f"{broken} holds no whole message")
            copy.finish()
            new.flush()
    except NotMcapError as error:
        raise RecoverError(f"{error}, so there is nothing to recover") from None
    except OSError as error:
        raise RecoverError(f"cannot read {broken}: {error.strerror}") from None
    return Recovery(out=str(out), messages=copy.messages, channels=len(copy.topics), lost=list(map(str, damages)))


class McapCopy:
    """Copies records into a new file, which is empty; counts its messages and collects its topics.

    `library` is the name of the writing program.
    """

    def __init__(self, out: BinaryIO, library: str) -> None:
        self.messages = 0
        self.topics: set[str] = set()
        self._writer = Writer(out, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        self._ids: dict[Hashable, int] = {}  # of schemas and channels
        self._attachments: set[Hashable] = set()
        self._metadata: dict[tuple[str, str | None], dict[str, str]] = {}  # the last of each name and key
        self._writer.start(profile="aeroloop", library=library)

    def file(
        self,
        path: Path,
        damages: list[Damage],
        progress: Callable[[int], None],
        follow: Callable[[str, Message], object] | None = None,
        dropped: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Copy what a file holds without dropped topics, and call `follow` with the topic of each message and itself.

        Damages, progress and errors are as of `records`; OSError also if the new file cannot be written.
        """
        schemas = {0: 0}  # of the new file, by the ids of this one
        channels: dict[int, tuple[int, str]] = {}
        for record in records(path, damages, progress):
            match record:
                case Message(id_, log_time, data, publish_time, sequence) if id_ in channels:
                    channel, topic = channels[id_]
                    self.add(channel, log_time, publish_time, data, sequence)
                    if follow is not None:
                        follow(topic, record)
                case Schema():
                    schemas[record.id] = self.schema(record.name, record.encoding, record.data)
                case Channel(id_, topic, encoding, metadata, schema) if not dropped(topic):
                    channels[id_] = self.channel(topic, encoding, schemas.get(schema, 0), metadata), topic
                case Metadata(name=name, metadata=entries):
                    if self._metadata.get(which := (name, entries.get("key"))) != entries:
                        self._metadata[which] = entries
                        self._writer.add_metadata(name, entries)
                case Attachment(created, logged, name, kind, data) if (name, data) not in self._attachments:
                    self._attachments.add((name, data))
                    self._writer.add_attachment(created, logged, name, kind, data)

    def add(self, channel: int, log_time: int, publish_time: int, data: bytes, sequence: int = 0) -> None:
        """Add a message; times in ns since 1970."""
        self._writer.add_message(channel, log_time, data, publish_time, sequence)
        self.messages += 1

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Id of a schema in the new file."""
        what = name, encoding, data
        if what not in self._ids:
            self._ids[what] = self._writer.register_schema(*what)
        return self._ids[what]

    def channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str] | None = None) -> int:
        """Id of a channel in the new file; schema 0 is none."""
        what = topic, encoding, schema, tuple((metadata or {}).items())
        if what not in self._ids:
            self._ids[what] = self._writer.register_channel(topic, encoding, schema, metadata or {})
            self.topics.add(topic)
        return self._ids[what]

    def finish(self) -> None:
        """Write the last descriptions again, as the recorder does, and the index. Nothing more can be added."""
        for (name, _), entries in self._metadata.items():
            if name == DESCRIPTION_METADATA:
                self._writer.add_metadata(name, entries)
        self._writer.finish()
