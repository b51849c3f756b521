"""Plant end on Zenoh: claims and operator commands, the session's link, status, events, trace, true states.

Claims, operator commands and lost peers arrive in other threads and are queued until the owner takes them between
ticks, so that only one thread uses the endpoint.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from datetime import UTC, datetime
from threading import Condition
from typing import Final

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, VehicleClaim
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.hosts.latch_file import KEPT_S, Latch, LatchFile
from aeroloop.plant_emulator.hosts.quanser_board import QuanserPlant
from aeroloop.plant_emulator.hosts.trace import PlantTrace
from aeroloop.plant_emulator.plant import Plant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Grant, Refusal, Release, SessionRecord, Status
from aeroloop.protocol.messages.operator import Advance, Answer, Inject, Mark, MessageError, Request
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome, record_json
from aeroloop.protocol.runtime.node import ASKED_BY, Node, RecorderWatch
from aeroloop.protocol.runtime.timing import LatencyHistogram, RollingHistogram
from aeroloop.protocol.transport.link import Arrival, ZenohLink
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

STATUS_PERIOD_NS: Final = 1_000_000_000
OTHERS_PERIOD_NS: Final = 10_000_000  # between two reads of the newest status of another plant of this name


def run_plant(role: Node, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
    """Run Quanser's board or the plant that `plant.kind` names until the role stops; then 0 V and a last status.

    Raises PluginError or PlantError; ValueError if it does not fit the wire or the configured faults.
    """
    if settings.via == "quanser":
        plant: Plant = QuanserPlant(settings.quanser, loop.period, settings.watchdog_s)
    else:
        plant = settings.make(loop.period)
    with closing(plant):
        endpoint = settings.endpoint(plant, loop, wire)
        Driver(endpoint, ZenohNetwork(role, loop, endpoint, settings), loop, role.stop).run()


class ZenohNetwork(PlantNetwork):
    """A plant end, an Endpoint or the bridge's Relay, on the network.

    LatchFile keeps the latch in `plant.state_directory`, and one that is there holds from the start. `changed` is
    notified when a command arrives, for an owner that waits for more than one thing.
    """

    def __init__(
        self,
        role: Node,
        loop: LoopSettings,
        endpoint: VehicleClaim,
        settings: PlantSettings,
        changed: Condition | None = None,
    ) -> None:
        super().__init__()
        self._role, self._loop, self._endpoint, self._changed = role, loop, endpoint, changed
        self._plant_end = endpoint if isinstance(endpoint, Endpoint) else None  # None: it is behind a bridge
        self._computed = settings.via == "emulator"
        self.steps = 0 if settings.steps_on_request else None
        truth_hz = settings.truth_rate_hz
        self._truth_every = max(1, round(loop.rate_hz / truth_hz)) if truth_hz else 0
        self._link: ZenohLink | None = None
        self._trace = PlantTrace(endpoint.wire, lambda batch: role.publish_bytes("trace", batch))
        self._latency = RollingHistogram()
        self._latency_counts = LatencyHistogram()
        self._counters = endpoint.wire.measurement.counters
        self._sent_at: list[tuple[int, int]] = []  # per counter: session tick of its last frame, and its time sent
        self._received = 0
        self._refused = 0  # by the links of earlier sessions
        self._latch_file = LatchFile(settings.state_directory, role.vehicle)
        self._since = datetime.now(UTC) if endpoint.cause else None
        if (found := self._latch_file.found) is not None:
            endpoint.start_tripped(found.cause, found.text, operator_only=found.operator_only)
            self._since = found.since
        self._published = endpoint.state, -1, time.monotonic()  # by the last status: state and tick, and when
        self._status_due = self._others_due = 0
        self._recorder = RecorderWatch(role)
        self._forget_holder: Callable[[], None] = lambda: None

    @property
    def link(self) -> ZenohLink | None:
        return self._link

    # ── the loop's calls, in their order ──

    def serve(self) -> None:
        role = self._role
        role.declare("trace", lossless=self._loop.lockstep)
        if not self._loop.lockstep:
            role.datagrams.listen()
        role.serve("claim", Claim, lambda claim: lambda: self._claim(claim))
        role.serve("release", Release, lambda release: lambda: self._release(release))
        role.serve("record", SessionRecord, self._keep_record)
        role.serve("show", Request, lambda _: self._last_record())
        role.serve("arm", Request, lambda _: self._once_kept(self._arm))
        role.serve("stop", Request, lambda _: self._once_kept(self._stop), by_datagrams=True)
        role.serve("forwarded_stop", Request, lambda _: self._once_kept(self._stop))
        role.serve("mark", Mark, lambda mark: lambda: self._mark(mark.text))
        if self._computed:
            role.serve("inject", Inject, lambda request: lambda: self._inject(request))
            role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        self._others = role.zenoh.declare_subscriber(
            topics.key("status", role.vehicle, role=role.role), RingChannel(1), allowed_origin=zenoh.Locality.REMOTE
        )
        role.announce()
        if (found := self._latch_file.found) is None:
            role.event("started", f"{role.vehicle} waits for a claim")
        else:
            text = f"{found.text} ({found.since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC)"
            role.event("started", f"{role.vehicle} is still tripped: {text}; `aeroloop op arm` clears it")

    def take_inbox(self) -> None:
        if time.monotonic_ns() >= self._others_due:
            self._read_others()
        if self._role.take_inbox():
            self.follow_session()

    def wait_for_inbox(self, timeout_s: float) -> None:
        self._role.wait_for_inbox(timeout_s)

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        endpoint = self._endpoint
        self._trace.row(endpoint, measurement, arrival, sent_ns)
        if endpoint.outcome is Outcome.ACTED:
            tick, at_ns = self._sent_at[endpoint.answered % self._counters]
            if tick == endpoint.answered >= 0:
                latency_ns = (sent_ns if arrival is None else arrival.at_ns) - at_ns
                self._latency.add(latency_ns)
                self._latency_counts.add(latency_ns)
        elif endpoint.outcome is Outcome.STALE:
            text = "commands answer measurements older than the watchdog's time: refused"
            self._role.warn("stale", "fault", text, endpoint.session, endpoint.event_tick)
        if measurement:
            self._sent_at[endpoint.counter] = endpoint.session_tick, sent_ns
        self._received += arrival is not None and arrival.frame != UNCHANGED
        self.follow_session()
        due = self._truth_every and endpoint.ticked % self._truth_every == 0
        if due and self._plant_end is not None and (truth := self._plant_end.truth()) is not None:
            self._role.publish("truth", truth)

    def follow_session(self) -> None:
        endpoint = self._endpoint
        if endpoint.notices:
            self._keep_latch()
        self._trace.follow(endpoint)
        if endpoint.session is None:
            self._close_link()
        if endpoint.notices:
            for notice in endpoint.notices:
                self._role.event(*notice)
            endpoint.notices.clear()
            self._status_due = 0
        if time.monotonic_ns() >= self._status_due or endpoint.state is not self._published[0]:
            self.publish_status()

    def publish_status(self) -> None:
        endpoint, role, end = self._endpoint, self._role, self._plant_end
        now = time.monotonic()
        _, tick, then = self._published
        role.status(
            Status(
                role=role.role,
                state=endpoint.state,
                session=endpoint.session,
                cause=endpoint.cause,
                since=self._since,
                unkept=self._latch_file.problem,
                datagrams=role.datagrams.endpoint,
                uptime_s=role.uptime_s,
                ticks=endpoint.ticked + 1,
                rate_hz=max(0.0, (endpoint.ticked - tick) / (now - then)),
                skipped=self.skipped,
                received=self._received,
                sent=self.sent,
                refused=endpoint.refused + self._refused + (self._link.refused if self._link else 0),
                stale=endpoint.stale,
                saturated=end.saturated if end else 0,
                latency_us=self._latency.total.summary(),
                recent_latency_us=self._latency.recent(),
                latency_counts=self._latency_counts.report(),
                trips=dict(endpoint.trips),
                timing=self.timing.report() if self.timing else None,
                notes=[*self.notes, *([end.plant.note] if end and end.plant.note else [])],
                lacks_recorder="gone" if self._recorder.gone else None,
                faults=end.fault_statuses() if end else [],
            )
        )
        self._published = endpoint.state, endpoint.ticked, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS

    def leave(self) -> None:
        try:
            self.follow_session()
            self._trace.finish()
        finally:
            self._latch_file.wait()
        self._role.event("stopped", f"{self._role.vehicle} stopped at 0 V")
        self.publish_status()

    # ── claims ──

    def _claim(self, claim: Claim) -> Grant | Refusal:
        role = self._role
        answer = self._endpoint.claim(claim)
        if isinstance(answer, Refusal):
            text = f"{claim.controller} refused: {answer.reason}"
            role.warn(text, "refused", text, claim.session)
            return answer
        self._close_link()  # of a session that ended in the same batch of requests
        self._sent_at = [(-1, 0)] * self._counters
        self._link = ZenohLink(  # before the grant is sent, so that the first command is not lost
            role.zenoh,
            send_key=topics.key("measurement", role.vehicle, session=claim.session),
            receive_key=topics.key("command", role.vehicle, session=claim.session),
            accepts=self._endpoint.wire.acceptance("command", lockstep=self._loop.lockstep),
            lossless=self._loop.lockstep,
            changed=self._changed,
            also=self._role.datagrams.session,
        )

        def seen(appeared: bool) -> None:
            if not appeared:
                role.enqueue(lambda: self._endpoint.lost(claim.controller))

        self._forget_holder = role.watch_token(claim.controller, seen)
        return answer

    def _close_link(self) -> None:
        """Close the link of the session that has ended, if there is one."""
        if self._link is not None:
            self._link.close()
            self._refused += self._link.refused
            self._link = None
            self._forget_holder()

    def _release(self, release: Release) -> Answer:
        done = self._endpoint.release(release.session)
        return Answer(done=done, text="released" if done else f"no session {release.session} runs here")

    def _keep_record(self, record: SessionRecord) -> Callable[[], Answer]:
        changes = record_json(record.in_force)  # of many points it takes milliseconds

        def keep() -> Answer:
            if not self._endpoint.keep(record):
                return Answer(done=False, text=f"no session {record.session} of {record.controller} runs")
            self._trace.record(changes)
            return Answer(done=True, text="kept")

        return keep

    def _inject(self, request: Inject) -> Answer:
        assert self._plant_end is not None
        done = self._plant_end.inject([Fault.parse(text) for text in request.faults], clear=request.clear)
        self.follow_session()  # here, so that its events name the operator
        return Answer(done=bool(done), text="; ".join(done) or "no fault was given")

    def _advance(self, seconds: float) -> Answer:
        if self.steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self.steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")

    def _last_record(self) -> SessionRecord | Answer:
        """For any thread: the endpoint replaces its record, which is frozen, as a whole."""
        return self._endpoint.last or Answer(done=False, text=f"{self._role.vehicle} has no record of a session")

    def _read_others(self) -> None:
        """Trip if another plant end publishes under this one's name, as after a network was cut and healed."""
        self._others_due = time.monotonic_ns() + OTHERS_PERIOD_NS
        if (sample := self._others.try_recv()) is None or self._endpoint.trip is TripCause.DUPLICATE:
            return
        with suppress(MessageError):
            other = Status.decode(sample.payload.to_bytes(), extra="ignore").process
            which = f"this one ({self._role.process}) and another ({other})"
            text = f"two plants are named {self._role.vehicle}, {which}; end one of them, then `aeroloop op arm`"
            self._endpoint.stop(TripCause.DUPLICATE, text)
            self.follow_session()

    # ── operator commands and the latch ──

    def _arm(self) -> Answer:
        vehicle = self._role.vehicle
        if self._endpoint.arm():
            return Answer(done=True, text=f"{vehicle} is armed: the next controller to claim it may drive it")
        return Answer(done=False, text=f"{vehicle} is held by {self._endpoint.holder}, so there is nothing to arm")

    def _stop(self) -> Answer:
        by = ASKED_BY.get()
        self._endpoint.stop(reason=f"stopped by an operator ({by})" if by else "stopped by an operator")
        return Answer(done=True, text=f"{self._role.vehicle} is at 0 V; `aeroloop op arm` lets it be driven again")

    def _mark(self, text: str) -> Answer:
        tick = self._endpoint.event_tick
        self._role.event("marked", text, self._endpoint.session, tick)
        if not self._recorder.present:
            return Answer(done=False, text="no recorder runs: the mark is in a log only if one starts within a minute")
        return Answer(done=True, text=f"marked{'' if tick is None else f' at tick {tick}'}: {text}")

    def _once_kept(self, change: Callable[[], Answer]) -> Callable[[], Answer]:
        """Queue a change of the latch, and answer when it is on disk. Waits in the topic's thread, not in the loop."""
        answers: list[Answer] = []
        changed = threading.Event()

        def apply() -> None:
            answers.append(change())
            self.follow_session()
            changed.set()

        def answer() -> Answer:
            unkept = self._latch_file.unkept
            more = f"; but a restart of the plant would forget it: {unkept}" if unkept else ""
            return answers[0].model_copy(update={"text": answers[0].text + more})

        self._role.enqueue(apply)
        changed.wait(KEPT_S)
        self._latch_file.wait()
        return answer

    def _keep_latch(self) -> None:
        """Have the latch of a tripped plant on disk, and none of one that is not."""
        end, latch = self._endpoint, None
        if end.cause is None:
            self._since = None
        elif any(notice.kind == "tripped" for notice in end.notices):
            self._since = datetime.now(UTC)
        if end.trip is not None and end.cause is not None and self._since is not None:
            latch = Latch(cause=end.trip, text=end.cause, operator_only=end.operator_only, since=self._since)
        self._latch_file.keep(latch)
