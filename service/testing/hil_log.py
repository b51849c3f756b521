"""Log of a hardware-in-the-loop run: figures, events, trips and messages, and the evidence of a failure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.operator import Change, Message
from aeroloop.protocol.messages.trace import Batch, End, Received, Sent, read_batch
from aeroloop.service.figures import Figures
from aeroloop.service.review.review import read, review
from aeroloop.service.testing.process_group import HilError


@dataclass(frozen=True)
class RunFigures:
    """Figures of merit of a run that has ended; reading one that its log lacks raises HilError."""

    found: Figures

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
        """Every figure of merit, from the log alone. Raises ReviewError if it holds no session."""
        return RunFigures(review(self._existing()))

    @property
    def events(self) -> list[Event]:
        """Events in order."""
        return [message for _, message in self.messages("event") if isinstance(message, Event)]

    @property
    def trips(self) -> list[str]:
        """Cause of each trip of the plant, in order."""
        return [event.text for event in self.events if event.kind == "tripped"]

    def batches(self, end: End) -> list[Batch]:
        """Trace batches of one end, in the order of recording."""
        read = [read_batch(content) for _, content in self.messages("trace") if isinstance(content, bytes)]
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

    def messages(self, name: str) -> list[tuple[int, Message | bytes]]:
        """Time of publication [ns] and content of every message of one topic, by that time, of equal ones as recorded.

        Frames and traces are bytes.
        """
        found: list[tuple[int, Message | bytes]] = []
        topic = topics.TOPICS[name]
        with self._existing().open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                address = topics.read_key(channel.topic)
                if address is not None and address.topic is topic:
                    content = topic.model.model_validate_json(message.data) if topic.model else message.data
                    found.append((message.publish_time, content))
        return sorted(found, key=lambda each: each[0])

    def evidence(self, received: Sequence[Event]) -> Iterator[str]:
        """Write page and events beside the log; yield a line for each file, or the reason why there is none.

        Args:
            received: Events received while the loop ran, for a log that cannot be read.
        """
        if not self.path.exists():
            yield f"{self.path}: no log was written"
            return
        yield f"{self.path}: the log"
        events, shown = self.path.with_name(f"{self.path.stem}-events.txt"), self.path.with_suffix(".html")
        try:
            timed = [(at, event) for at, event in self.messages("event") if isinstance(event, Event)]
            lines = [f"{(at - timed[0][0]) * 1e-9:9.3f} s  {_line(event)}" for at, event in timed]
        except Exception:  # whatever a broken log makes its reader raise
            lines = [_line(event) for event in received]
        events.write_text("\n".join(lines) + "\n", encoding="utf-8")
        yield f"{events}: {len(lines)} events"
        try:
            from aeroloop.service.report.page import page

            shown.write_text(page([read(self.path).report()]), encoding="utf-8")
        except Exception as error:  # the same; and without the extra `review` there is no page
            yield f"no page: {type(error).__name__}: {error}".splitlines()[0]
        else:
            yield f"{shown}: the review as a page"

    def _existing(self) -> Path:
        if not self.path.exists():
            raise HilError(f"no log was written at {self.path}")
        return self.path


def _line(event: Event) -> str:
    tick = "" if event.tick is None else f"  (tick {event.tick})"
    return f"{event.role:<10}  {event.kind:<8}  {event.text}{tick}"
