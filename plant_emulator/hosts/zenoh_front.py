"""Plant end on Zenoh.

Answers claims and operator commands, opens and closes the session's link, publishes status, events and the trace, and
counts the frames. Claims, operator commands and lost peers arrive in other threads and are queued until the owner
takes them between ticks, so that only one thread uses the endpoint.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.plant_emulator.endpoint.front import Front
from aeroloop.plant_emulator.endpoint.tenancy import Tenancy
from aeroloop.plant_emulator.hosts.trace_rows import PlantTrace
from aeroloop.protocol.messages import intake, topics
from aeroloop.protocol.messages.models import (
    Claim,
    FaultStatus,
    Grant,
    Refusal,
    Release,
    SessionRecord,
    Status,
    Tenure,
)
from aeroloop.protocol.messages.operator import Answer, Request
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome, batches_per_s
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.runtime.timing import RollingHistogram, report, summary
from aeroloop.protocol.transport.link import Arrival, Mailbox, Wake, ZenohLink
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.transmit import SILENCE

STATUS_PERIOD_NS: Final = 1_000_000_000
OTHERS_PERIOD_NS: Final = 10_000_000
"""How often the statuses of another plant of this name are read, of those the newest."""


class ZenohFront(Front):
    """A plant end, an Endpoint or the bridge's Relay, on the network.

    `changed` is set when a command arrives, for an owner that waits for more than one thing; `faults` returns the
    status of an emulator's faults.
    """

    def __init__(
        self,
        role: Role,
        loop: LoopSettings,
        endpoint: Tenancy,
        changed: Wake | None = None,
        faults: Callable[[], list[FaultStatus]] = list,
    ) -> None:
        super().__init__()
        self._faults = faults
        self._role = role
        self._loop = loop
        self._endpoint = endpoint
        self._link: ZenohLink | None = None
        self._changed = changed
        self._trace = PlantTrace(loop, endpoint.wire, lambda batch: role.publish_bytes("trace", batch))
        self._latency = RollingHistogram()
        self._counters = endpoint.wire.measurement.counters
        self._sent_at: list[tuple[int, int]] = []  # per counter: session tick of its last frame, and its time sent
        self._sent = self._received = 0
        self._published_state = endpoint.state
        self._since = _now() if endpoint.cause else None
        self._status_tick = -1
        self._status_due = self._others_due = 0
        self._status_time = time.monotonic()
        self._forget_holder: Callable[[], None] | None = None

    @property
    def link(self) -> ZenohLink | None:
        """Link of the session's frames; None without a session."""
        return self._link

    def serve(self) -> None:
        """Declare the topics, and answer claims and operator commands from now on."""
        role = self._role
        role.declare("trace", batches_per_s(self._loop), lossless=self._loop.lockstep)
        role.serve("claim", Claim, lambda claim: lambda: self._claim(claim))
        role.serve("release", Release, lambda release: lambda: self._release(release))
        role.serve("record", SessionRecord, lambda record: lambda: self._keep(record))
        role.serve("show", Request, lambda _: self._show)
        role.serve("arm", Request, lambda _: self._arm)
        role.serve("stop", Request, lambda _: self._stop)
        if not self._loop.lockstep:
            role.datagrams.listen()
        self._others = role.zenoh.declare_subscriber(
            topics.key("status", role.vehicle, role=role.role), RingChannel(1), allowed_origin=zenoh.Locality.REMOTE
        )
        role.announce()
        role.event("started", f"{role.vehicle} waits for a claim")

    def take_inbox(self) -> None:
        """Process queued claims, releases and operator commands, and the status of another plant."""
        if time.monotonic_ns() >= self._others_due:
            self._read_others()
        if self._role.take_inbox():
            self.follow_session()

    def send(self, frame: bytes) -> None:
        """Send a measurement frame; SILENCE is sent only in lockstep, where the controller cannot detect it by time."""
        if self._link is not None and (frame or self._loop.lockstep):
            self._link.send(frame)
            self._sent += frame != SILENCE

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """After the measurement was sent: write the trace row, measure latency, publish events and a due status."""
        endpoint = self._endpoint
        self._trace.row(endpoint, measurement, arrival, sent_ns)
        if endpoint.outcome is Outcome.ACTED:
            answered = endpoint.answered
            tick, at_ns = self._sent_at[answered % self._counters]
            if tick == answered >= 0:
                self._latency.add((sent_ns if arrival is None else arrival.at_ns) - at_ns)
        elif endpoint.outcome is Outcome.STALE:
            text = "commands answer measurements older than the watchdog's time: refused"
            self._role.warn("stale", "fault", text, endpoint.session, endpoint.event_tick)
        if measurement:
            self._sent_at[endpoint.session_tick % self._counters] = endpoint.session_tick, sent_ns
        if arrival is not None:
            self._received += arrival.frame != SILENCE
        self.follow_session()
        self.publish_when_due()

    def follow_session(self) -> None:
        """Publish events, and close the link of a session that ended."""
        self._trace.follow(self._endpoint)
        endpoint = self._endpoint
        if endpoint.state is not self._published_state:
            self._published_state = endpoint.state
            self._status_due = 0
        if endpoint.session is None and self._link is not None:
            self._link.close()
            self._link = None
            if self._forget_holder is not None:
                self._forget_holder()
        if not endpoint.notices:
            return
        if endpoint.cause is None:
            self._since = None
        elif any(notice.kind == "tripped" for notice in endpoint.notices):
            self._published_state = endpoint.state
            self._since = _now()
        for notice in endpoint.notices:
            self._role.event(*notice)
        endpoint.notices.clear()
        self._status_due = 0

    def publish_when_due(self) -> None:
        """Publish the status once a second, and at once after an event or a change of state."""
        if time.monotonic_ns() >= self._status_due:
            self.publish_status()

    def leave(self) -> None:
        """Publish the end of the trace, the stop and a last status."""
        self.follow_session()
        self._trace.finish()
        self._role.event("stopped", f"{self._role.vehicle} stopped at 0 V")
        self.publish_status()

    # ── queries and tokens from other threads, processed between ticks ──

    def _watch(self, holder: str) -> None:
        def seen(appeared: bool) -> None:
            if not appeared:
                self._role.enqueue(lambda: self._endpoint.lost(holder))

        self._forget_holder = self._role.watch_token(holder, seen)

    def _read_others(self) -> None:
        """Another plant end publishes under this one's name, as after a network was cut and healed."""
        self._others_due = time.monotonic_ns() + OTHERS_PERIOD_NS
        if (sample := self._others.try_recv()) is not None:
            with suppress(intake.IntakeError):
                self._contest(intake.read(Tenure, sample.payload.to_bytes(), intake.STATUS).process)
                self.follow_session()

    def _contest(self, other: str) -> None:
        if self._endpoint.trip is not TripCause.DUPLICATE:
            plants = f"this one ({self._role.process}) and another ({other})"
            text = f"two plants are named {self._role.vehicle}, {plants}; end one of them, then `aeroloop op arm`"
            self._endpoint.stop(TripCause.DUPLICATE, text)

    def _claim(self, claim: Claim) -> Grant | Refusal:
        answer = self._endpoint.claim(claim)
        if isinstance(answer, Refusal):
            text = f"{claim.controller} refused: {answer.reason}"
            self._role.warn(text, "refused", text, claim.session)
            return answer
        vehicle = self._role.vehicle
        self._sent_at = [(-1, 0)] * self._counters
        self._link = ZenohLink(  # before the grant is sent, so that the first command is not lost
            self._role.zenoh,
            send_key=topics.key("measurement", vehicle, session=claim.session),
            receive_key=topics.key("command", vehicle, session=claim.session),
            lossless=self._loop.lockstep,
            mailbox=None if self._loop.lockstep and self._changed is None else Mailbox(self._changed),
            also=self._role.datagrams.session,
        )
        self._watch(claim.controller)
        return answer

    def _release(self, release: Release) -> Answer:
        done = self._endpoint.release(release.session)
        return Answer(done=done, text="released" if done else f"no session {release.session} runs here")

    def _keep(self, record: SessionRecord) -> Answer:
        done = self._endpoint.keep(record)
        return Answer(done=done, text="kept" if done else f"no session {record.session} of {record.controller} runs")

    def _show(self) -> SessionRecord | Answer:
        return self._endpoint.last or Answer(done=False, text=f"{self._role.vehicle} has no record of a session")

    def _arm(self) -> Answer:
        vehicle = self._role.vehicle
        if self._endpoint.arm():
            return Answer(done=True, text=f"{vehicle} is armed: the next controller to claim it may drive it")
        return Answer(done=False, text=f"{vehicle} is held by {self._endpoint.holder}, so there is nothing to arm")

    def _stop(self) -> Answer:
        self._endpoint.stop()
        return Answer(done=True, text=f"{self._role.vehicle} is at 0 V; `aeroloop op arm` lets it be driven again")

    def publish_status(self) -> None:
        """Publish the status."""
        now = time.monotonic()
        endpoint = self._endpoint
        self._latency.turn_when_due()
        self._role.status(
            Status(
                role=self._role.role,
                state=endpoint.state,
                session=endpoint.session,
                cause=endpoint.cause,
                since=self._since,
                datagrams=self._role.datagrams.endpoint,
                uptime_s=self._role.uptime_s,
                ticks=endpoint.ticked + 1,
                rate_hz=max(0.0, (endpoint.ticked - self._status_tick) / (now - self._status_time)),
                skipped=self.skipped,
                received=self._received,
                sent=self._sent,
                refused=endpoint.refused,
                stale=endpoint.stale,
                saturated=endpoint.saturated,
                latency_us=summary(self._latency.total),
                recent_latency_us=summary(self._latency.recent()),
                timing=report(self.timing) if self.timing else None,
                notes=self.notes,
                faults=self._faults(),
            )
        )
        self._status_tick, self._status_time = endpoint.ticked, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
