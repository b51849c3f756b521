"""Recorder process: writes what every role publishes into MCAP files.

It only subscribes, and recovers from publishers' caches what it did not receive, the newest messages first. Twice a
second it takes the received messages and writes them, so log times are exact to 0.5 s and a crash costs the open chunk
and 0.5 s, which the restarted recorder recovers. While the disk refuses, nothing is taken: messages wait where they are
received, and then in their caches.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Description, Loss, LossReason, Status
from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.states import NOT_RECORDING, RECORDING, STOPPED
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.history import SOON_S, Delivery, RecoveringSubscriber
from aeroloop.service.recording.rolling import RollingLog
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.schemas import Decoded

if TYPE_CHECKING:
    from aeroloop.service.viewers.channels import Decoder

WORK_EVERY_S: Final = 0.5  # messages can wait: a chunk is closed only once a second
STATUS_EVERY_S: Final = 1.0
DECODED_HZ: Final = 10.0  # of each decoded channel beside the raw messages
END_S: Final = 8.0  # longest time for what caches hold when recording ends; a service manager kills after 10


class Recorder:
    """The recorder as a process. Raises RecorderError if the log cannot be written."""

    def __init__(self, role: Node, settings: RecorderSettings) -> None:
        self.log = RollingLog(settings, self._report)
        self._waiting: deque[tuple[Delivery, int]] = deque()  # taken and not yet written, with times of arrival
        self._role = role
        self._lost: Counter[LossReason] = Counter()
        self._unreachable: list[str] = []  # traces of which nothing is received as recording ends
        self._described: dict[str, int] = {}  # when each key's newest description was published [ns since 1970]
        self._status_at, self._status_written = time.monotonic(), 0
        self._decoder: Decoder | None = None
        try:
            from aeroloop.service.viewers.channels import Decoder

            self._decoder = Decoder(DECODED_HZ)
        except ModuleNotFoundError:
            role.event("changed", "no decoded channels: they need `pip install 'aeroloop[foxglove]'`")
        self._subscribers = [RecoveringSubscriber(role.zenoh, topics.key(name, "*")) for name in topics.RECORDED]

    def run(self) -> None:
        """Record until the role's `stop` is set; then take what caches still hold and close the log."""
        self._role.announce()
        self._role.event("started", f"recording to {self.log.path}")
        status_due, stopped = 0.0, False
        try:
            while not stopped:
                self._work()
                if time.monotonic() >= status_due:
                    self._publish_losses(self._losses())
                    self._publish_status()
                    status_due = time.monotonic() + STATUS_EVERY_S
                self.log.tend()
                stopped = self._role.stop.wait(WORK_EVERY_S if self._complete() or self.log.trouble else SOON_S)
        finally:
            self._end()

    def _end(self) -> None:
        """Take what caches hold, name what is lost, and close the log, whatever fails before that."""
        try:
            self._take_the_rest()
        finally:
            self.log.close(len(self._waiting))

    def _take_the_rest(self) -> None:
        """Take what caches hold for at most `END_S`, name what is lost, and publish the last status."""
        self.log.tend(at_once=True)
        begun = time.monotonic()
        while not (self._complete(begun) or self.log.trouble or time.monotonic() > begun + END_S):
            self._work()
            time.sleep(SOON_S)
        for subscriber in self._subscribers:
            for key, age_s in subscriber.silent().items():
                if "/trace/" in key:
                    what = "what it has published since is not in the log"
                    self._unreachable.append(f"nothing of {key} was received for {age_s:.0f} s: {what}")
                    self._role.event("lost", self._unreachable[-1])
        losses = self._losses(finished=True)
        self._work(at_last=True)
        self._publish_losses(losses)
        self._publish_status()
        self._work(at_last=True)

    # ── messages ──

    def _complete(self, since: float | None = None) -> bool:
        return all(subscriber.complete(since) for subscriber in self._subscribers)

    def _work(self, *, at_last: bool = False) -> None:
        """Take the received messages and write them. While the disk refuses, take none, unless it is the last time."""
        now_ns = time.time_ns()
        for subscriber in self._subscribers if at_last or not self.log.trouble else ():
            for received in subscriber.take():
                address = topics.read_key(received.key)
                if address is not None and address.topic.name == "description":
                    self._describe(received)
                self._waiting.append((received, now_ns))
        while self._waiting and not self.log.trouble:
            received, at_ns = self._waiting.popleft()
            address, decoded = topics.read_key(received.key), list[Decoded]()
            if self._decoder is not None and address is not None:
                decoded = self._decoder.take(address, received.payload, received.published_ns)
            self.log.add(received, at_ns, decoded)

    def _describe(self, received: Delivery) -> None:
        """Put a role's newest description into the log's metadata."""
        if received.published_ns < self._described.get(received.key, 0):
            return  # recovered after a newer one
        try:
            Description.decode(received.payload)
        except MessageError:
            self._role.warn(received.key, "fault", f"{received.key} carries no description of this version")
            return
        self._described[received.key] = received.published_ns
        self.log.add_description(received.key, received.payload)

    # ── reports ──

    def _losses(self, *, finished: bool = False) -> list[Loss]:
        return [loss for each in self._subscribers for loss in each.losses(finished=finished)]

    def _publish_losses(self, losses: list[Loss]) -> None:
        """Publish, and thereby record, losses."""
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
        now, written = time.monotonic(), self.log.written
        notes = [f"{count} messages lost: {LOSS_REASONS[reason]}" for reason, count in sorted(self._lost.items())]
        notes += self._unreachable
        state = STOPPED if self._role.stop.is_set() else NOT_RECORDING if self.log.trouble else RECORDING
        rate_hz = (written - self._status_written) / max(now - self._status_at, 1e-3)
        self._role.status(Status(
            role=self._role.role, state=state, cause=self.log.trouble or None, uptime_s=self._role.uptime_s, ticks=0,
            rate_hz=rate_hz, skipped=0, received=written, lost=self._lost.total(), notes=notes,
        ))  # fmt: skip
        self._status_at, self._status_written = now, written
