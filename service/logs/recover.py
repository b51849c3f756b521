"""Recovery: everything that is whole in a broken log, written into a new one with its index.

A log without its end, such as a recorder that was killed leaves behind, is read from the front. Messages keep their
topics, schemas, times and sequence; what could not be read is named.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer
from pydantic import BaseModel, ConfigDict, Field

from protocol.errors import AeroloopError
from service.logs.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK_BYTES,
    MESSAGE,
    METADATA,
    SCHEMA,
    Damage,
    Message,
    NotMcapError,
    Record,
    records,
    summary,
)


class RecoverError(AeroloopError):
    """Nothing can be recovered; one line that says why."""


class Recovery(BaseModel):
    """What was recovered."""

    model_config = ConfigDict(frozen=True)

    out: str
    messages: int
    channels: int
    lost: list[str] = Field(description="what could not be read, a line each; empty if the file was whole")


def recover(broken: Path, out: Path, progress: Callable[[float], None] | None = None) -> Recovery:
    """Write all that can be read of a log into a new file.

    Args:
        broken: The log; it is not changed.
        out: The new file, which must not exist.
        progress: Called now and then with the share that is done, 0…1.

    Raises:
        RecoverError: It is no MCAP file, or the new one cannot be written.
    """
    damages: list[Damage] = []
    try:
        size = broken.stat().st_size
        with out.open("xb") as file:
            copy = _Copy(Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD))
            for record in summary(broken):
                copy.add(record, damages)
            for record in records(broken, damages, lambda read: progress(read / size) if progress else None):
                copy.add(record, damages)
            copy.writer.finish()
    except NotMcapError as error:
        out.unlink()
        raise RecoverError(f"{error}, so there is nothing to recover") from None
    except FileExistsError:
        raise RecoverError(f"{out} exists already; name another file") from None
    except OSError as error:
        raise RecoverError(f"cannot recover {broken} into {out}: {error.strerror}") from None
    if not copy.messages:
        out.unlink()
        raise RecoverError(f"{broken} holds no whole message")
    lost = [f"at byte {damage.offset}: {damage.what}" for damage in damages]
    return Recovery(out=str(out), messages=copy.messages, channels=len(copy.channels), lost=lost)


class _Copy:
    """Writes records again, with ids of its own."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self.messages = 0
        self.schemas: dict[int, int] = {0: 0}
        self.channels: dict[int, int] = {}
        writer.start(profile="aeroloop", library="aeroloop log recover")

    def add(self, record: Record, damages: list[Damage]) -> None:
        """Copy a record of which anything is kept; what cannot be told apart in it is damage."""
        try:
            if record.opcode == MESSAGE:
                self._message(Message.read(record.content), record, damages)
            elif record.opcode == SCHEMA:
                schema = Schema.read(_stream(record))
                if schema.id not in self.schemas:
                    self.schemas[schema.id] = self.writer.register_schema(schema.name, schema.encoding, schema.data)
            elif record.opcode == CHANNEL:
                channel = Channel.read(_stream(record))
                if channel.id not in self.channels:
                    self.channels[channel.id] = self.writer.register_channel(
                        channel.topic,
                        channel.message_encoding,
                        self.schemas.get(channel.schema_id, 0),
                        channel.metadata,
                    )
            elif record.opcode == METADATA:
                metadata = Metadata.read(_stream(record))
                self.writer.add_metadata(metadata.name, metadata.metadata)
            elif record.opcode == ATTACHMENT:
                attachment = Attachment.read(_stream(record))
                self.writer.add_attachment(
                    attachment.create_time,
                    attachment.log_time,
                    attachment.name,
                    attachment.media_type,
                    attachment.data,
                )
        except (struct.error, UnicodeDecodeError, ValueError, EOFError) as error:
            damages.append(Damage(record.offset, f"a record cannot be read: {error}"))

    def _message(self, message: Message, record: Record, damages: list[Damage]) -> None:
        channel = self.channels.get(message.channel)
        if channel is None:
            damages.append(Damage(record.offset, f"a message of channel {message.channel}, which was lost"))
            return
        self.writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        self.messages += 1


def _stream(record: Record) -> ReadDataStream:
    return ReadDataStream(BytesIO(record.content))
