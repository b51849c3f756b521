"""The recorder process: what both ends and all others publish, into MCAP files.

It only subscribes. Traces, messages and descriptions are published from caches, so a recorder that starts late or again
recovers the last minute. Twice a second it takes what was received and writes it, so log times are exact
to 0.5 s. A channel per key holds the raw payloads, decoded channels stand beside them at a bounded rate, and what was
lost is published and recorded.

A crash costs this process what the open chunk holds and 0.5 s; its successor recovers that from the caches.
"""

from __future__ import annotations

import time
from collections import Counter
from functools import lru_cache
from typing import Final, Literal

from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Loss, Status
from aeroloop.protocol.messages.trace import read_batch
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.publication import Delivery
from aeroloop.service.recording.backlog import Backlog
from aeroloop.service.recording.rolling import RollingLog
from aeroloop.service.recording.subscriptions import Subscriptions
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.channels import Decoded, Decoder

WORK_EVERY_S: Final = 0.5
"""Messages can wait: a chunk is closed only once a second."""

STATUS_EVERY_S: Final = 1.0

AT_ONCE: Final = 2000
"""Messages written before the rings are looked at again."""

QUIET_S: Final = 0.3
"""A network from which nothing was received for so long has nothing more on its way [s]."""

ANSWER_S: Final = 5.0
"""How long a role may take to answer before recording ends without its last messages [s]."""

GOES_ON_S: Final = 1.0
"""A network that does not become quiet in this time goes on for good [s]."""

_address = lru_cache(maxsize=4096)(topics.read_key)


class Recorder:
    """The recorder as a process.

    Args:
        role: Its presence on the network.
        settings: Where the log goes.

    Attributes:
        log: What is written.

    Raises:
        RecorderError: The log cannot be written.
    """

    def __init__(self, role: Role, settings: RecorderSettings) -> None:
        self._role = role
        self._frames = settings.frames
        self._backlog = Backlog()
        self._lost: Counter[str] = Counter()  # by reason
        self._status_due = 0.0
        self._status_written = 0
        self._status_at = time.monotonic()
        self.log = RollingLog(settings, self._report)
        self._decoder = Decoder(settings.decoded_hz) if settings.decoded_hz else None

    def run(self) -> None:
        """Record until the role's `stop` is set; then take what is still on its way and close the log."""
        self._subscriptions = Subscriptions(self._role.zenoh, frames=self._frames)
        self._role.announce()
        self._role.event("started", f"recording to {self.log.path}")
        try:
            while not self._role.stop.wait(0.0 if self._behind else WORK_EVERY_S):
                self._take()
                self._role.take_inbox()
                if time.monotonic() >= self._status_due:
                    self._publish_losses()
                    self._publish_status()
                self.log.tend()
        finally:
            self._settle()
            self.log.try_again()
            self._take_all()
            self._publish_losses()
            self._take_all()
            self._publish_losses()  # and those of which the publisher was not known a moment ago
            self._publish_status()
            self._take_all()
            self.log.close(len(self._backlog))

    def reconfigure(self, settings: RecorderSettings) -> None:
        """Take over what can change while recording."""
        self.log.settings = settings

    def _settle(self) -> None:
        """Take what is on its way. A role's answer follows all that it published before, as a link keeps the order."""
        for _ in self._role.zenoh.get(topics.key("description", "*"), timeout=ANSWER_S):
            pass
        now = last = time.monotonic()
        deadline = now + GOES_ON_S
        while now < deadline and (now - last < QUIET_S or self._subscriptions.joining):
            time.sleep(0.0 if self._behind else QUIET_S / 10)
            now = time.monotonic()
            if self._take():
                last = now

    @property
    def _behind(self) -> bool:
        """Whether there is something to write, and it can be."""
        return self.log.writable and len(self._backlog) > 0

    def _take_all(self) -> None:
        self._take(held=True)
        while self._behind:
            self._write()

    def _take(self, *, held: bool = False) -> int:
        """Take what was received, and write some of what waits. How many messages were received."""
        count, now = 0, time.time_ns()
        for received in self._subscriptions.take(held=held):
            count += 1
            address = _address(received.key)
            if address is not None and address.topic.name == "description":
                self._configure(received)  # at once: without it the rest cannot be read
            if not self._backlog.room(received):
                self._write()
            self._backlog.put(received, now)
        self._write()
        return count

    def _write(self) -> None:
        """Write what has waited longest, `AT_ONCE` messages at the most, unless the disk refuses."""
        for _ in range(AT_ONCE):
            if not self.log.writable or (entry := self._backlog.next()) is None:
                return
            received, at_ns = entry
            self.log.add(received, at_ns, self._decode(received, at_ns))

    def _decode(self, received: Delivery, at_ns: int) -> list[Decoded]:
        address = _address(received.key)
        if address is None or address.topic.carries == "frame":
            return []
        if address.topic.name == "trace" and (batch := read_batch(received.payload)) is not None:
            for change in batch.tail.changes:
                self.log.add_change(received.key, change)
            return self._decoder.rows(address.vehicle, batch) if self._decoder else []
        at_ns = at_ns if received.published_ns is None else max(0, received.published_ns)
        return self._decoder.take(address, received.payload, at_ns) if self._decoder else []

    def _configure(self, received: Delivery) -> None:
        try:
            description = Description.model_validate_json(received.payload)
        except ValidationError:
            self._role.warn(received.key, "fault", f"{received.key} carries no description of this version")
            return
        self.log.add_description(received.key, received.payload)
        if self._decoder is not None:
            self._decoder.configure(description)

    def _publish_losses(self) -> None:
        """Publish, and thereby record, what was lost; what found no room once the disk has some again."""
        for lost in self._subscriptions.losses():
            self._lose(lost.key, lost.messages, lost.reason)
        if self.log.writable:
            refused, self._backlog.refused = self._backlog.refused, Counter()
            for key, count in refused.items():
                self._lose(key, count, "disk")

    def _lose(self, key: str, count: int, reason: Literal["network", "queue", "disk"]) -> None:
        self._lost[reason] += count
        self._role.publish("loss", Loss(key=key, count=count, reason=reason))

    def _report(self, text: str, bad: bool) -> None:
        if bad:
            self._role.warn("disk", "fault", text)
        else:
            self._role.event("changed", text)

    def _publish_status(self) -> None:
        now = time.monotonic()
        written, log = self.log.written, self.log
        notes = [f"{count} messages lost: {reason}" for reason, count in sorted(self._lost.items())]
        if log.trouble:
            notes.append(f"{log.trouble}; {len(self._backlog)} messages wait")
        state = "stopped" if self._role.stop.is_set() else "recording" if log.writable else "waiting for the disk"
        self._role.status(
            Status(
                role=self._role.role,
                state=state,
                uptime_s=self._role.uptime_s,
                ticks=0,
                rate_hz=(written - self._status_written) / max(now - self._status_at, 1e-3),
                skipped=0,
                received=written,
                notes=notes,
            )
        )
        self._status_written, self._status_at, self._status_due = written, now, now + STATUS_EVERY_S
