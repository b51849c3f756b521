"""The recorder process: everything that crosses the network, as it crossed, into MCAP files.

It is only a subscriber: messages gather in an intake and are written many at a time. A channel per key holds the raw
payloads with their time of publication; decoded channels stand beside them at a bounded rate. Every role's contract,
with its effective configuration and the wire spec, is fetched when the role appears and stands in every file, so that
one file needs nothing else to be read. What was lost is found by its sender's numbers and written into the log.

A crash costs what the open chunk holds, `chunk_s` at the most, and what was on its way there: 0.1 s, or 1 s while a
role is asked for its contract and does not answer.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import Counter, deque
from typing import Final, Literal

from pydantic import ValidationError

from protocol import topics
from protocol.messages import Contract, Loss, Status
from protocol.role import Role
from service.logs.decoded import Decoded, Decoder
from service.recording.intake import Intake, Taken
from service.recording.rolling import RollingLog
from service.settings import RecorderSettings

log: Final = logging.getLogger("aeroloop")

WORK_EVERY_S: Final = 0.2
"""Messages can wait: a chunk is closed only once a second."""

STATUS_EVERY_S: Final = 1.0
ASK_EVERY_S: Final = 1.0
CHANGED: Final = "?"
"""Somebody whose configuration was read again and so has another contract; nobody's name."""
SETTLED_S: Final = 3.0
"""After this everybody who was there before the recorder has been heard: statuses come once a second."""


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
        self._batch_s = settings.batch_s
        self._addresses: dict[str, topics.Address | None] = {}
        self._tokens: deque[tuple[str, bool]] = deque()  # who has come or gone
        self._silent: set[str] = set()  # who has appeared and not yet told its contract
        self._ask_due = 0.0
        self._lost: Counter[str] = Counter()  # by reason
        self._status_due = 0.0
        self._status_written = 0
        self._status_at = time.monotonic()
        self._disk_failed = False  # since losses were last told
        self.log = RollingLog(settings, self._tell)
        self._decoder = Decoder(settings.decoded_hz) if settings.decoded_hz else None

    def run(self) -> None:
        """Record until the role is told to stop; then take what is still on its way and close the log."""
        self._intake = Intake(self._role.zenoh, topics.EVERYTHING, self._batch_s)
        self._role.watch_tokens(lambda name, came: self._tokens.append((name, came)))
        self._role.announce()
        self._role.event("started", f"recording to {self.log.path}")
        gc.freeze()  # a collection looks at the messages that wait, not at all that was ever imported
        try:
            while not self._role.stop.wait(WORK_EVERY_S):
                self._work()
        finally:
            if not self._intake.settle():
                self._role.event("lost", "stopped while more came than could be taken in: the log lacks the last of it")
            self.log.try_again()
            self._status_due = 0.0
            self._work()
            self._intake.close()
            self._drain()
            self.log.close(len(self._intake))

    def reconfigure(self, settings: RecorderSettings) -> None:
        """Take over what can change while recording."""
        self.log.settings = settings

    def _work(self) -> None:
        self._drain()
        self._role.take_inbox()
        self._fetch_contracts()
        if time.monotonic() >= self._status_due:
            self._intake.numbers.settled = self._role.uptime_s > SETTLED_S
            self._tell_losses()
            self._publish_status()
        self.log.tend()

    def _drain(self) -> None:
        intake, log = self._intake, self.log
        while log.writable and (taken := intake.next()) is not None:
            self._take(taken)

    def _take(self, taken: Taken) -> None:
        if taken.missing:
            self._lose(taken.key, taken.missing, "network", taken.published_ns)
        address = self._address(taken.key)
        decoded: list[Decoded] = []
        if address is not None:
            if self._decoder is not None:
                decoded = self._decoder.take(address, taken.payload, taken.published_ns)
            if address.topic.name == "change":
                self.log.add_change(taken)
            elif address.topic.name == "event" and b'"changed"' in taken.payload:
                self._tokens.append((CHANGED, True))
        self.log.add(taken, decoded)

    def _address(self, key: str) -> topics.Address | None:
        if key not in self._addresses:
            self._addresses[key] = topics.read_key(key)
        return self._addresses[key]

    def _lose(self, key: str, count: int, reason: Literal["network", "queue", "disk"], until_ns: int) -> None:
        """Tell the network, and thereby the log, of a loss."""
        self._lost[reason] += count
        self._role.publish("loss", Loss(key=key, count=count, reason=reason, until_ns=until_ns))

    def _tell_losses(self) -> None:
        """Tell what found no room, once there is room to tell it."""
        if not self.log.writable:
            return
        refusals, now = self._intake.refusals(), time.time_ns()
        for key, count in refusals.messages.items():
            self._lose(key, count, "disk" if self._disk_failed else "queue", now)
        for key, count in refusals.missing.items():
            if count:
                self._lose(key, count, "network", now)
        self._disk_failed = False

    def _fetch_contracts(self) -> None:
        """Ask who appeared for its contract, until each has told it; every role answers for itself."""
        while self._tokens:
            name, came = self._tokens.popleft()
            if came:
                self._silent.add(name)
                self._ask_due = 0.0
            else:
                self._silent.discard(name)
        now = time.monotonic()
        if not self._silent or now < self._ask_due:
            return
        self._ask_due = now + ASK_EVERY_S
        for reply in self._role.zenoh.get(topics.key("contract", "*"), timeout=1.0):
            if reply.ok is not None:
                self._hear(str(reply.ok.key_expr), reply.ok.payload.to_bytes())

    def _hear(self, key: str, payload: bytes) -> None:
        """A role's contract."""
        try:
            contract = Contract.model_validate_json(payload)
        except ValidationError:
            self._role.warn(key, "fault", f"{key} does not answer with a contract of this version: not recorded")
            return
        self._silent = {name for name in self._silent if name.partition("-")[0] not in (contract.role, CHANGED)}
        self.log.add_contract(key, payload)
        if self._decoder is not None:
            self._decoder.configure(contract)

    def _tell(self, text: str, bad: bool) -> None:
        if bad:
            self._disk_failed = self._disk_failed or not self.log.writable
            self._role.warn("disk", "fault", text)
        else:
            self._role.event("changed", text)

    def _publish_status(self) -> None:
        now = time.monotonic()
        written, log = self.log.written, self.log
        notes = [f"{count} messages lost: {reason}" for reason, count in sorted(self._lost.items())]
        if log.trouble:
            notes.append(f"{log.trouble}; {len(self._intake)} messages wait")
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
