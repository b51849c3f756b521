"""Copies of a log: what can be read of a broken one, and a run with every message decoded.

A copy has its own ids; messages keep their topic, schema, times and sequence. Schemas, channels and attachments that
several files repeat are written once.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer
from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.service.logs.mcap_file import CHUNK_BYTES, NotMcapError, records
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress, Recording

if TYPE_CHECKING:  # recovery needs no decoder
    from aeroloop.service.viewers.channels import Decoder


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

    Raises OutputError if the new file must not be written, or cannot; RecoverError if there is nothing to recover.
    """
    try:
        broken.stat()
        with writing(out, [broken], force=force) as part:
            messages, names, lost = _copy([broken], part, "aeroloop log recover", progress)
            if not messages:
                raise RecoverError(f"{broken} holds no whole message")
    except NotMcapError as error:
        raise RecoverError(f"{error}, so there is nothing to recover") from None
    except OSError as error:
        raise RecoverError(f"cannot read {broken}: {error.strerror}") from None
    return Recovery(out=str(out), messages=messages, channels=len(names), lost=lost)


def write_decoded(
    recording: Recording, out: Path, progress: Progress | None = None, span_ns: Sequence[int] | None = None
) -> tuple[int, list[str], list[str]]:
    """Write a run as one log with every message decoded, which the recorder does at a bounded rate only.

    With a span only messages recorded from its first to its last time [ns since 1970].

    Returns how many messages were written, their topics, and what could not be read. Raises OSError.
    """
    from aeroloop.service.viewers.channels import Decoder

    decoder = Decoder(rate_hz=None)
    for description in recording.descriptions.values():
        decoder.configure(description)
    messages, names, _ = _copy(recording.paths, out, "aeroloop log export", progress, decoder, span_ns)
    malformed = [f"malformed: {decoder.malformed} of what is decoded"] if decoder.malformed else []
    return messages, names, [*recording.damaged, *malformed]


def _copy(
    paths: Sequence[Path],
    out: Path,
    program: str,
    progress: Progress | None,
    decoder: Decoder | None = None,
    span_ns: Sequence[int] | None = None,
) -> tuple[int, list[str], list[str]]:
    """Copy what can be read of some files into one; with a decoder, what it decodes replaces what was decoded before.

    Returns how many messages were written, their topics, and what could not be read, a line each. Raises NotMcapError,
    and OSError if a file cannot be read or the new one cannot be written.
    """
    messages, done, size = 0, 0, max(1, sum(path.stat().st_size for path in paths))
    names, attached, damages = set[str](), set[str](), list[str]()
    with out.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        writer.start(profile="aeroloop", library=program)
        schema_id = cache(writer.register_schema)

        @cache
        def channel_id(topic: str, encoding: str, schema: int) -> int:
            names.add(topic)
            return writer.register_channel(topic, encoding, schema)

        for path in paths:
            schemas, channels = {0: 0}, dict[int, tuple[int, str]]()  # by the ids of this file

            def report(read: int, before: int = done) -> None:
                if progress is not None:
                    progress((before + read) / size)

            for record in records(path, damages, report):
                match record:
                    case Message(log_time=at) if span_ns and not span_ns[0] <= at <= span_ns[1]:
                        pass
                    case Message() if record.channel_id in channels:
                        channel, topic = channels[record.channel_id]
                        writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                        address = topics.read_key(topic) if decoder else None
                        decoded = decoder.take(address, record.data, record.publish_time) if decoder and address else []
                        for topic, shape, data, at_ns in decoded:  # log time is that of publication, as recorded
                            schema = schema_id(shape.name, shape.encoding, shape.schema)
                            writer.add_message(channel_id(topic, shape.message_encoding, schema), at_ns, data, at_ns)
                        messages += 1 + len(decoded)
                    case Schema():
                        schemas[record.id] = schema_id(record.name, record.encoding, record.data)
                    case Channel(id_, topic, encoding, _, schema) if not (decoder and topic.startswith("/")):
                        channels[id_] = channel_id(topic, encoding, schemas.get(schema, 0)), topic
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case Attachment() if record.name not in attached:
                        attached.add(record.name)
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
            done += path.stat().st_size
        writer.finish()
    return messages, sorted(names), damages
