"""A copy of a log: all that can be read of a run, or what is around an event, as one file with an index.

A copy has its own ids; messages keep their topic, schema, times and sequence. Schemas, channels and attachments that
several files repeat are written once.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from math import inf
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer
from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.trace import RECORD_S
from aeroloop.service.logs.mcap_file import CHUNK_BYTES, records
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.session import SessionKey, Unknown

BEFORE_NS: Final = round(1.2e9 * RECORD_S)  # a cut begins so much earlier, to have a record of what was in force


class ExportError(AeroloopError):
    """A log cannot be exported; one line with the reason."""


class Exported(BaseModel, frozen=True):
    """What was exported."""

    out: str
    format: str
    sessions: list[str] | None = Field(default=None, description="`vehicle/session` of the rows; null of a log")
    rows: int = Field(description="rows of a table, messages of a log")
    columns: list[str] = Field(description="names of a table's columns, topics of a log's channels")
    bytes: int
    damages: list[str] = Field(description="what of the log could not be read")
    unknown: list[Unknown] = Field(default=[], description="ticks left out: the log does not hold what was in force")
    left_out: list[str] = Field(default=[], description="other sessions of the log that the table does not have")
    law_unknown: str | None = Field(default=None, description="why the table lacks the law's own columns, if it does")
    around: list[str] = Field(default=[], description="events that `around` names; the export is around the first")


def copy(
    paths: Sequence[Path],
    out: Path | None = None,
    *,
    around: tuple[str, float] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write all that can be read of a run into one log, or so many seconds before and after an event.

    The new file has the first log's name with another ending if `out` is None; events are as of `events_named`.

    Raises:
        ExportError: There is nothing to copy, or no such event.
        OutputError: The file must not be written, or cannot.
        ReviewError: The log cannot be read.
    """
    out, events, span_ns = out or beside(paths, "-copy.mcap"), [], (-inf, inf)
    with writing(out, paths, force=force) as part:
        recording = Recording(paths, progress)
        if around is not None:
            events = events_named(recording, around[0])
            at_ns, half_ns = events[0][2], round(around[1] * 1e9)
            span_ns = at_ns - half_ns - BEFORE_NS, at_ns + half_ns
        messages, topics = _copy(recording.paths, part, span_ns)
        if not messages:
            raise ExportError(f"{recording.name} holds no whole message")
        size = part.stat().st_size
    return Exported(
        out=str(out), format="mcap", rows=messages, columns=topics, bytes=size, damages=recording.unread,
        around=[one.text for one, *_ in events],
    )  # fmt: skip


def beside(paths: Sequence[Path], ending: str) -> Path:
    """The path beside the first log that has its name, with another ending."""
    log = paths[0].resolve() if paths[0].is_dir() else paths[0]  # "." has no name
    return log.with_name((log.name if log.is_dir() else log.stem) + ending)


def events_named(recording: Recording, what: str, vehicle: str | None = None) -> list[tuple[Event, SessionKey, int]]:
    """Events by `trip`, `fault`, `mark` or words of a mark, each with its session and when it was recorded [ns].

    Raises ExportError if there is none.
    """
    found, kind = list[tuple[Event, SessionKey, int]](), {"trip": "tripped", "mark": "marked"}.get(what, what)
    for address, message in recording.messages:
        if address.topic.name == "event" and vehicle in (None, address.vehicle):
            with suppress(ValueError):  # malformed, which a review counts
                event = Event.model_validate_json(message.data)
                if event.kind == kind or (event.kind == "marked" and what in event.text):
                    found.append((event, (address.vehicle, event.session or ""), message.log_time))
    if not found:
        raise ExportError(f"{recording.name} has no event {what!r}: name trip, fault, mark, or words of a mark")
    return found


def _copy(paths: Sequence[Path], out: Path, span_ns: tuple[float, float]) -> tuple[int, list[str]]:
    """Copy messages recorded within a span and all else into one file; returns how many, and their topics."""
    messages, names, attached = 0, set[str](), set[str]()
    with out.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        writer.start(profile="aeroloop", library="aeroloop log export")
        schema_id = cache(writer.register_schema)

        @cache
        def channel_id(topic: str, encoding: str, schema: int) -> int:
            names.add(topic)
            return writer.register_channel(topic, encoding, schema)

        for path in paths:
            schemas, channels = {0: 0}, dict[int, int]()  # by the ids of this file
            for record in records(path):
                match record:
                    case Message() if record.channel_id in channels and span_ns[0] <= record.log_time <= span_ns[1]:
                        channel = channels[record.channel_id]
                        writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                        messages += 1
                    case Schema():
                        schemas[record.id] = schema_id(record.name, record.encoding, record.data)
                    case Channel(id_, topic, encoding, _, schema):
                        channels[id_] = channel_id(topic, encoding, schemas.get(schema, 0))
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case Attachment() if record.name not in attached:
                        attached.add(record.name)
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
        writer.finish()
    return messages, sorted(names)
