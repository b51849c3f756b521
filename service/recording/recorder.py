"""Recorder process: writes what every role publishes into MCAP files.

It only subscribes. Traces, messages and descriptions are published from caches, so a recorder that starts late, is
restarted or was cut off recovers the last minute, the newest messages first: a file is in the order of arrival. Twice a
second it takes the received messages and writes them, so log times are exact to 0.5 s. A channel per key holds the raw
payloads, decoded channels are written at a bounded rate, and losses are published and recorded.

A crash costs the open chunk and 0.5 s; the restarted recorder recovers them from the caches. One that is stopped first
takes what caches still hold.
"""

from __future__ import annotations

import ctypes
import time
from collections import Counter
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Description, Loss, LossReason, Status
from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.states import NOT_RECORDING, STOPPED
from aeroloop.protocol.messages.trace import read_batch
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.history import ANSWER_S, SOON_S, Delivery
from aeroloop.service.recording.backlog import Backlog
from aeroloop.service.recording.rolling import RollingLog
from aeroloop.service.recording.subscriptions import Subscriptions
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.schemas import Decoded

if TYPE_CHECKING:
    from aeroloop.service.viewers.channels import Decoder

WORK_EVERY_S: Final = 0.5
"""Messages can wait: a chunk is closed only once a second."""

MANY: Final = 100
"""After so many at once, as of a flood, the next are taken `SOON_S` later, as while caches are queried."""

STATUS_EVERY_S: Final = 1.0

DESCRIPTION_BYTES: Final = 4_194_304
"""Descriptions read meanwhile: at full length, each takes 20 ms."""

AT_ONCE: Final = 2000
"""Messages written before messages are taken from the rings again."""

END_S: Final = 8.0
"""Longest time for what caches hold when recording ends [s]; a service manager kills after 10."""

TRIM_BYTES: Final = 4_000_000
"""After so many bytes are written, freed memory goes back to the system: after a flood, malloc would keep it."""

_malloc_trim: Final = getattr(ctypes.CDLL(None), "malloc_trim", None)
"""Of glibc; other C libraries have none."""

_address = lru_cache(maxsize=4096)(topics.read_key)


class Recorder:
    """The recorder as a process. Raises RecorderError if the log cannot be written."""

    def __init__(self, role: Node, settings: RecorderSettings) -> None:
        self._role = role
        self._backlog = Backlog()
        self._lost: Counter[LossReason] = Counter()
        self._silent: list[str] = []  # what cannot be reached as recording ends
        self._described: dict[str, int] = {}  # when each key's newest description was published [ns since 1970]
        self._status_due = 0.0
        self._written_bytes = 0  # since memory was last given back
        self._status_written = 0
        self._status_at = time.monotonic()
        self.log = RollingLog(settings, self._report)
        self._decoder: Decoder | None = None
        if settings.decoded_hz:
            try:
                from aeroloop.service.viewers.channels import Decoder
            except ModuleNotFoundError:
                role.event("changed", "no decoded channels: they need `pip install 'aeroloop[foxglove]'`")
            else:
                self._decoder = Decoder(settings.decoded_hz)

    def run(self) -> None:
        """Record until the role's `stop` is set; then take what caches still hold and close the log."""
        self._subscriptions = Subscriptions(self._role.zenoh)
        self._role.announce()
        self._role.event("started", f"recording to {self.log.path}")
        try:
            taken = 0
            while not self._role.stop.wait(self._pause_s(taken)):
                taken = self._take()
                if time.monotonic() >= self._status_due:
                    self._publish_losses(self._subscriptions.losses())
                    self._publish_status()
                self.log.tend()
        finally:
            losses = self._take_last()
            self.log.try_again()
            self._take_all()
            self._publish_losses(losses)
            self._publish_status()
            self._take_all()
            self.log.close(len(self._backlog))

    def _take_last(self) -> list[Loss]:
        """Take what caches hold, while pages bring something, and return what is lost thereby."""
        now = begun = time.monotonic()
        while now < min(begun + END_S, max(begun, self._subscriptions.news) + ANSWER_S):
            self._take(last=True)
            if self._subscriptions.complete(begun):
                break
            time.sleep(0.0 if self._behind else SOON_S)
            now = time.monotonic()
        for key, age_s in self._subscriptions.silent().items():
            self._silent.append(
                f"nothing of {key} was received for {age_s:.0f} s: what it has published since is not in the log"
            )
            self._role.event("lost", self._silent[-1])
        return self._subscriptions.losses(finished=True)

    def _pause_s(self, taken: int) -> float:
        if self._behind:
            return 0.0
        return SOON_S if taken >= MANY or self._subscriptions.recovering else WORK_EVERY_S

    @property
    def _behind(self) -> bool:
        """Whether messages wait and the disk accepts them."""
        return self.log.writable and len(self._backlog) > 0

    def _take_all(self) -> None:
        self._take()
        while self._behind:
            self._write()

    def _take(self, *, last: bool = False) -> int:
        """Take the received messages and write some of those waiting. Returns the number received."""
        count, described, now = 0, 0, time.time_ns()
        for received in self._subscriptions.take(last=last):
            count += 1
            address = _address(received.key)
            if address is not None and address.topic.name == "description":
                described += len(received.payload)
                if described <= DESCRIPTION_BYTES:
                    self._configure(received, now)  # at once: other messages are decoded by it
            if not self._backlog.room(received):
                self._write()
            self._backlog.put(received, now)
        self._write()
        return count

    def _write(self) -> None:
        """Write the oldest messages, at most `AT_ONCE`, unless the disk refuses."""
        for _ in range(AT_ONCE):
            if not self.log.writable or (entry := self._backlog.next()) is None:
                break
            received, at_ns = entry
            self.log.add(received, at_ns, self._decode(received, at_ns))
            self._written_bytes += len(received.payload)
        if self._written_bytes > TRIM_BYTES:
            self._written_bytes = 0
            if _malloc_trim is not None:
                _malloc_trim(0)

    def _decode(self, received: Delivery, at_ns: int) -> list[Decoded]:
        address = _address(received.key)
        if self._decoder is None or address is None:
            return []
        if address.topic.name == "trace" and (batch := read_batch(received.payload)) is not None:
            return self._decoder.rows(address.vehicle, batch)
        at_ns = at_ns if received.published_ns is None else max(0, received.published_ns)
        return self._decoder.take(address, received.payload, at_ns)

    def _configure(self, received: Delivery, at_ns: int) -> None:
        published_ns = received.published_ns or at_ns
        if published_ns < self._described.get(received.key, 0):
            return  # recovered after a newer one
        try:
            description = Description.decode(received.payload)
        except MessageError:
            self._role.warn(received.key, "fault", f"{received.key} carries no description of this version")
            return
        self._described[received.key] = published_ns
        self.log.add_description(received.key, received.payload)
        if self._decoder is not None:
            self._decoder.configure(description)

    def _publish_losses(self, losses: list[Loss]) -> None:
        """Publish, and thereby record, losses; those of the full backlog once the disk accepts writes again."""
        if self.log.writable:
            losses += [Loss(key=key, count=count, reason="disk") for key, count in self._backlog.refused.items()]
            self._backlog.refused.clear()
        for loss in losses:
            self._lost[loss.reason] += loss.count
            self._role.publish("loss", loss)
            text = f"{loss.count} messages of {loss.key} are not in the log: {LOSS_REASONS[loss.reason]}"
            self._role.warn(f"{loss.key} {loss.reason}", "fault", text)

    def _report(self, text: str, bad: bool) -> None:
        if bad:
            self._role.warn("disk", "fault", text)
        else:
            self._role.event("changed", text)

    def _publish_status(self) -> None:
        now = time.monotonic()
        written, log = self.log.written, self.log
        notes = [f"{count} messages lost: {LOSS_REASONS[reason]}" for reason, count in sorted(self._lost.items())]
        notes += self._silent
        if log.trouble:
            notes.append(f"{len(self._backlog)} messages wait in memory")
        state = STOPPED if self._role.stop.is_set() else "recording" if log.writable else NOT_RECORDING
        rate_hz = (written - self._status_written) / max(now - self._status_at, 1e-3)
        self._role.status(Status(
            role=self._role.role, state=state, cause=log.trouble or None, uptime_s=self._role.uptime_s, ticks=0,
            rate_hz=rate_hz, skipped=0, received=written, lost=self._lost.total(), notes=notes,
        ))  # fmt: skip
        self._status_written, self._status_at, self._status_due = written, now, now + STATUS_EVERY_S
