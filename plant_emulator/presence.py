"""What controllers and operators see of a plant: whoever stands at the plant end stands on the network through this.

It answers claims and operators' verbs, opens and closes the session's link, tells status and events, and keeps count of
the frames. Claims, verbs and lost peers come from Zenoh's threads and wait for the owner to take them between ticks:
the endpoint is only ever touched by one thread.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from threading import Condition
from typing import Final

from plant_emulator.front import Front
from plant_emulator.tenancy import Tenancy
from protocol import topics
from protocol.clock import LoopSettings, RollingHistogram
from protocol.links import Arrival, Mailbox, ZenohLink
from protocol.messages import Claim, Grant, Refusal, Release, Status, report, summary
from protocol.role import Role
from protocol.transmit import SILENCE
from protocol.verbs import Answer, Ask

STATUS_PERIOD_NS: Final = 1_000_000_000


class Presence(Front):
    """A plant end on the network.

    Args:
        role: Its name there.
        loop: The grid.
        endpoint: Who grants, refuses and trips.
        latest_s: A command is acted upon for so long after it was sent, and no longer [s].
        changed: Notified when a command arrives, for an owner that waits for more than one thing.

    Attributes:
        late: Commands that came too late to be acted upon.
    """

    def __init__(
        self, role: Role, loop: LoopSettings, endpoint: Tenancy, latest_s: float, changed: Condition | None = None
    ) -> None:
        super().__init__()
        self._role = role
        self._loop = loop
        self._endpoint = endpoint
        self._latest_ns = round(latest_s * 1e9)
        self._link: ZenohLink | None = None
        self._changed = changed
        self.late = 0
        self._latency = RollingHistogram()
        self._sent_at = [0] * endpoint.wire.measurement.counters
        self._sparse = endpoint.wire.transmit.measurement == "on_change"
        self._sent = self._received = 0
        self._told_state = endpoint.state
        self._since = _now() if endpoint.cause else None
        self._k = self._status_tick = -1
        self._status_due = 0
        self._status_time = time.monotonic()

    @property
    def link(self) -> ZenohLink | None:
        """The session's frames; None while there is no session."""
        return self._link

    def serve(self) -> None:
        """Answer claims and operators from now on."""
        role = self._role
        role.serve("claim", Claim, lambda claim: lambda: self._claim(claim))
        role.serve("release", Release, lambda release: lambda: self._release(release))
        role.serve("arm", Ask, lambda _: self._arm)
        role.serve("stop", Ask, lambda _: self._stop)
        role.watch_tokens(self._token)
        role.announce()
        role.event("started", f"{role.vehicle} waits for a claim")

    def take_inbox(self) -> None:
        """Between ticks: do what has come from controllers and operators."""
        if self._role.take_inbox():
            self.follow_session()

    def send(self, frame: bytes, counter: int) -> None:
        """Send a measurement frame of the session; silence is sent only where it could not be heard, in lockstep."""
        if self._link is None:
            return
        if self._sparse:
            for ahead in range(1, len(self._sent_at) // 2):
                self._sent_at[(counter + ahead) % len(self._sent_at)] = 0  # of these nothing was sent yet
        self._sent_at[counter] = time.monotonic_ns() if frame else 0
        if frame or self._loop.lockstep:
            self._link.send(frame)
        self._sent += frame != SILENCE

    def arrived(self, arrival: Arrival) -> bool:
        """Keep count of a command frame, and of how long it took. Whether it came in time to be acted upon.

        The four bits of its echo repeat every 16 ticks, so they cannot tell a stream that is late for good; its time of
        publication can. That is never before the publication of the measurement it answers, on the plant's own clock,
        whatever the controller's clock says (hybrid logical clocks), so nothing that is in time is taken for late.
        """
        self._received += arrival.frame != SILENCE
        late_ns = time.time_ns() - arrival.published_ns
        if late_ns > self._latest_ns and not self._loop.lockstep:
            text = f"commands come {late_ns * 1e-6:.0f} ms after they were sent: refused"
            self._role.warn("late", "fault", text, self._endpoint.session)
            self.late += 1
            return False
        read = self._endpoint.wire.command.unpack(arrival.frame)
        if read is not None and (sent_at := self._sent_at[read[0]]) and arrival.at_ns > sent_at:
            self._latency.add(arrival.at_ns - sent_at)
        return True

    def after_tick(self, k: int) -> None:
        """Tell what happened at tick k, and the status once a second."""
        self._k = k
        self.follow_session()
        self.tell_when_due()

    def follow_session(self) -> None:
        """Tell what happened, and close the link of a session that ended."""
        endpoint = self._endpoint
        if endpoint.state is not self._told_state:
            self._told_state = endpoint.state
            self._status_due = 0
        if endpoint.session is None and self._link is not None:
            self._link.close()
            self._link = None
        if not endpoint.notices:
            return
        if endpoint.cause is None:
            self._since = None
        elif any(notice.kind == "tripped" for notice in endpoint.notices):
            self._told_state = endpoint.state
        self._since = _now()
        for notice in endpoint.notices:
            self._role.event(*notice)
        endpoint.notices.clear()
        self._status_due = 0

    def tell_when_due(self) -> None:
        """Tell the status if a second is over, or something has happened."""
        if time.monotonic_ns() >= self._status_due:
            self.tell()

    def leave(self) -> None:
        """Tell that the plant is at 0 V and goes."""
        self.follow_session()
        self._role.event("stopped", f"{self._role.vehicle} stopped at 0 V")
        self.tell()

    # ── what came from Zenoh's threads, taken between ticks ──

    def _token(self, name: str, came: bool) -> None:
        if not came:
            self._role.later(lambda: self._endpoint.lost(name))

    def _claim(self, claim: Claim) -> Grant | Refusal:
        answer = self._endpoint.claim(claim)
        if isinstance(answer, Grant):
            self._open_link(claim.session)
        else:
            text = f"{claim.controller} refused: {answer.reason}"
            self._role.warn(text, "refused", text, claim.session)
        return answer

    def _release(self, release: Release) -> Answer:
        done = self._endpoint.release(release.session)
        return Answer(done=done, text="released" if done else f"no session {release.session} runs here")

    def _arm(self) -> Answer:
        vehicle = self._role.vehicle
        if self._endpoint.arm():
            return Answer(done=True, text=f"{vehicle} is armed: the next controller to claim it may drive it")
        return Answer(done=False, text=f"{vehicle} is held by {self._endpoint.holder}, so there is nothing to arm")

    def _stop(self) -> Answer:
        self._endpoint.stop()
        return Answer(done=True, text=f"{self._role.vehicle} is at 0 V; `aeroloop op arm` lets it be driven again")

    def _open_link(self, session: str) -> None:
        """Listen for commands before the grant goes out, so that the first one finds somebody."""
        vehicle = self._role.vehicle
        self._link = ZenohLink(
            self._role.zenoh,
            send_key=topics.key("measurement", vehicle, session=session),
            receive_key=topics.key("command", vehicle, session=session),
            lossless=self._loop.lockstep,
            mailbox=Mailbox(self._changed),
            numbers=self._role.numbers,
        )

    def tell(self) -> None:
        """Tell the status."""
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
                uptime_s=self._role.uptime_s,
                ticks=self._k + 1,
                rate_hz=max(0.0, (self._k - self._status_tick) / (now - self._status_time)),
                skipped=self.skipped,
                received=self._received,
                sent=self._sent,
                refused=endpoint.refused + self.late,
                saturated=endpoint.saturated,
                latency_us=summary(self._latency.total),
                recent_latency_us=summary(self._latency.recent()),
                timing=report(self.timing) if self.timing else None,
                notes=self.notes,
            )
        )
        self._status_tick, self._status_time = self._k, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
