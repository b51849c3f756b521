"""Log of a hardware-in-the-loop run: figures, events, trips and messages, and the evidence of a failure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from mcap.records import Channel
from mcap.records import Message as Recorded

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.operator import Change, Message
from aeroloop.protocol.messages.trace import Batch, End, Received, Sent, read_batch
from aeroloop.protocol.printable import printable
from aeroloop.service.logs.mcap_file import records
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import read
from aeroloop.service.testing.process_group import HilError
from aeroloop.service.testing.process_group import __tracebackhide__ as __tracebackhide__

M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class RunFigures:
    """What `aeroloop log review --json` says of a session; reading a figure that its log lacks raises HilError."""

    found: Findings

    def __repr__(self) -> str:
        """Short, because pytest prints it beside a figure that an assertion compares."""
        return f"figures of session {self.found.session}"

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.found, name)
        if value is None:
            raise HilError(f"the log gives no {name}: {self.found.reasons.get(name, 'no tick was recorded')}")
        return value


class HilLog:
    """The log of a run, an MCAP file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def figures(self) -> RunFigures:
        """Figures of the longest session, from the log alone; its `sessions` says how many there are."""
        return self.figures_of()

    def figures_of(self, session: int | None = None) -> RunFigures:
        """Figures of a session, by its number from 1 in the order of recording. Raises HilError if there is none."""
        try:
            return RunFigures(read(self._existing(), session=None if session is None else str(session)).findings)
        except AeroloopError as error:
            raise HilError(str(error)) from None

    @property
    def events(self) -> list[Event]:
        """Events in order."""
        return [event for _, event in self.messages(Event)]

    @property
    def trips(self) -> list[str]:
        """Cause of each trip of the plant, in order."""
        return [event.text for event in self.events if event.kind == "tripped"]

    def messages(self, model: type[M]) -> list[tuple[int, M]]:
        """Messages of one kind, such as `Truth`, with their times of publication [ns], in that order."""
        topic = next(topic for topic in topics.TOPICS.values() if topic.model is model)
        return [(at_ns, model.model_validate_json(content)) for at_ns, content in self._published(topic)]

    def batches(self, end: End) -> list[Batch]:
        """Trace batches of one end, in the order of publication."""
        read = [read_batch(content) for _, content in self._published(topics.TOPICS["trace"])]
        return [batch for batch in read if batch is not None and batch.header.end == end]

    def times(self, end: End, column: Literal["received", "sent"]) -> list[int]:
        """Times at which one end received or sent frames, on its wall clock [ns since 1970]."""
        frame = Received.FRAME if (end, column) == ("controller", "received") else Sent.FRAME
        return [
            at_ns + batch.header.wall_ns - batch.header.monotonic_ns
            for batch in self.batches(end)
            for at_ns, kind in zip(batch.times_ns(column).tolist(), batch.columns[f"{column}_as"].tolist(), strict=True)
            if at_ns >= 0 and kind == frame
        ]

    @property
    def changes(self) -> list[Change]:
        """Changes of references and gains that controllers applied, in order."""
        return [change for batch in self.batches("controller") for change in batch.tail.changes]

    def _published(self, topic: topics.Topic) -> list[tuple[int, bytes]]:
        addresses, found = dict[int, topics.Address | None](), list[tuple[int, bytes]]()
        for record in records(self._existing()):
            if isinstance(record, Channel):
                addresses[record.id] = topics.read_key(record.topic)
            elif isinstance(record, Recorded):
                address = addresses.get(record.channel_id)
                if address is not None and address.topic is topic:
                    found.append((record.publish_time, record.data))
        return sorted(found, key=lambda each: each[0])

    def evidence(self, received: Sequence[Event]) -> Iterator[str]:
        """Write page and events beside the log; yield a line for each file, or the reason why there is none.

        `received` are the events received while the loop ran, for a log that cannot be read.
        """
        if not self.path.exists():
            yield f"{self.path}: no log was written"
            return
        yield f"{self.path}: the log"
        events, shown = self.path.with_name(f"{self.path.stem}-events.txt"), self.path.with_suffix(".html")
        lines = [_line(event) for event in received]
        with suppress(Exception):  # whatever a broken log makes its reader raise
            timed = self.messages(Event)
            lines = [f"{(at - timed[0][0]) * 1e-9:9.3f} s  {_line(event)}" for at, event in timed] or lines
        events.write_text("\n".join(map(printable, lines)) + "\n", encoding="utf-8")
        yield f"{events}: {len(lines)} events"
        try:
            from aeroloop.service.report.page import page

            shown.write_text(page([read(self.path).report()]), encoding="utf-8")
            yield f"{shown}: the review as a page"
        except Exception as error:  # the same; and without the extra `review` there is no page
            yield f"no page: {type(error).__name__}: {error}".splitlines()[0]

    def _existing(self) -> Path:
        if not self.path.exists():
            raise HilError(f"no log was written at {self.path}")
        return self.path


def _line(event: Event) -> str:
    tick = "" if event.tick is None else f"  (tick {event.tick})"
    return f"{event.role:<10}  {event.kind:<8}  {event.text}{tick}"
