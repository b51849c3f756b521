"""The controller process: claim a vehicle, then wait → receive → tick → send → account, until told to stop.

Whenever it has no session it claims again, four times a second, so either end may start first and either may be
restarted. When measurements stop coming for longer than `stale_s` it gives the session up and says nothing more; the
plant's watchdog does the rest.
"""

from __future__ import annotations

import logging
import os
import time
import uuid
from enum import StrEnum
from typing import Final

import zenoh
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from protocol import topics
from protocol.clock import LoopSettings, TickGrid, prepare_process
from protocol.frames import COUNTERS, WireSpec
from protocol.links import Arrival, ZenohLink
from protocol.messages import Claim, Grant, Refusal, Release, Status, Telemetry
from protocol.role import Role
from service.controller import Controller
from service.law import LawSettings
from service.reference import SinusoidSettings, reference_function

log: Final = logging.getLogger("aeroloop")

STATUS_PERIOD_NS: Final = 1_000_000_000
PHASE_LOCK: Final = 64
"""The grid follows the plant's clock: each measurement moves it by this fraction of how far off it came."""

CLAIM_PERIOD_S: Final = 0.25
ANSWER_WAIT_S: Final = 1.0
FIRST_MEASUREMENT_S: Final = 1.0


class ControllerSettings(BaseModel):
    """How the controller daemon behaves."""

    model_config = ConfigDict(extra="forbid")

    stale_s: float = Field(
        default=0.1, gt=0, le=10, description="stop commanding after this long without a measurement [s]"
    )
    duration_s: float | None = Field(default=None, gt=0, description="end after this much of the law's time [s]")
    telemetry_rate_hz: float = Field(default=50.0, gt=0, le=10_000, description="publish telemetry this often [Hz]")
    require_recorder: bool = Field(default=False, description="do not claim before a recorder is there to see it")
    lead: float = Field(
        default=0.4,
        gt=0,
        lt=1,
        description="when in the plant's period the controller ticks: late enough for a delayed measurement to be "
        "there, early enough for its answer to act in the same period [periods]",
    )


class DaemonState(StrEnum):
    """What the daemon is doing."""

    SEARCHING = "searching"
    CLAIMED = "claimed"
    RUNNING = "running"
    HOLDING = "holding"


class Daemon:
    """The controller end as a process.

    Args:
        role: Its presence on the network; its name must be unique, because the plant knows its holder by it.
        loop: The grid.
        wire: How frames are read and written.
        law: Parameters and gains.
        reference: What the body shall do.
        settings: How it behaves.

    Raises:
        ValueError: The law's B cannot be inverted.
    """

    def __init__(
        self,
        role: Role,
        loop: LoopSettings,
        wire: WireSpec,
        law: LawSettings,
        reference: SinusoidSettings,
        settings: ControllerSettings,
    ) -> None:
        self._role = role
        self._loop = loop
        self._wire = wire
        self._law = law
        self._reference = reference_function(reference)
        self._settings = settings
        self._controller = self._new_controller()
        self._stale_ticks = max(1, loop.ticks(settings.stale_s))
        self._last_tick = loop.ticks(settings.duration_s) - 1 if settings.duration_s else None
        self._telemetry_every = max(1, round(loop.rate_hz / settings.telemetry_rate_hz))
        self._state = DaemonState.SEARCHING
        self._session: str | None = None
        self._recorders = 0
        self._told = ""
        self._sent = self._received = self._skipped = self._ticks = self._refused = self._saturated = 0
        self._notes: list[str] = []
        self._status_due = 0
        self._status_ticks = 0
        self._status_time = time.monotonic()

    def run(self) -> None:
        """Run until the role is told to stop or `duration_s` of the law's time are over."""
        if not self._loop.lockstep:
            self._notes = prepare_process()
        self._role.watch_tokens(self._token)
        self._role.announce()
        self._role.event("started", f"{self._role.name} looks for {self._role.vehicle}")
        try:
            finished = False
            while not finished and not self._role.stop.is_set():
                ready = self._recorders or not self._settings.require_recorder
                link = self._claim() if ready else None
                if link is None:
                    self._publish_when_due()
                    self._role.stop.wait(CLAIM_PERIOD_S)
                    continue
                try:
                    finished = self._run_lockstep(link) if self._loop.lockstep else self._run_real_time(link)
                finally:
                    self._release()
                    link.close()
        finally:
            self._state = DaemonState.HOLDING
            self._role.event("stopped", f"{self._role.name} stopped commanding")
            self._publish_status()

    # ── the two loops ──

    def _run_real_time(self, link: ZenohLink) -> bool:
        """One session on the grid. True once the duration is over, False if the session was lost."""
        first = link.wait(FIRST_MEASUREMENT_S)
        if first is None or (read := self._wire.measurement.unpack(first.frame)) is None:
            return self._lose("no measurement came")
        # The plant counts from 0 at the grant, so its counter is the law's tick, even if a first frame was lost.
        k = seen = read[0]
        period_ns = self._loop.period_ns
        lead_ns = round(self._settings.lead * period_ns)
        grid = TickGrid(period_ns, start_ns=first.at_ns + lead_ns - k * period_ns)
        grid.tick = k
        self._tick(link, first, k)
        while not self._role.stop.is_set() and (self._last_tick is None or seen < self._last_tick):
            skipped = grid.skipped
            k = grid.wait()
            self._skipped += grid.skipped - skipped
            arrival = link.take()
            measured = self._tick_of(arrival, k)
            self._tick(link, arrival, measured)
            if arrival is not None:
                seen = measured
                early_ns = grid.start_ns + measured * period_ns - arrival.at_ns - lead_ns
                grid.start_ns -= max(-period_ns, min(period_ns, early_ns)) // PHASE_LOCK
            elif k - seen >= self._stale_ticks:
                return self._lose(f"no measurement for {(k - seen) * self._loop.period * 1e3:.0f} ms")
        return not self._role.stop.is_set()

    def _tick_of(self, arrival: Arrival | None, k: int) -> int:
        """The tick at which a measurement was taken: the one with its counter that is nearest to our own tick k."""
        read = self._wire.measurement.unpack(arrival.frame) if arrival is not None else None
        if read is None:
            return k
        return k + (read[0] - k + COUNTERS // 2) % COUNTERS - COUNTERS // 2

    def _run_lockstep(self, link: ZenohLink) -> bool:
        """One session, a tick for every measurement. True once the duration is over, False if the session was lost."""
        k, seen = -1, time.monotonic()
        while not self._role.stop.is_set() and k != self._last_tick:
            arrival = link.wait(self._settings.stale_s)
            if arrival is not None:
                k, seen = k + 1, time.monotonic()
                self._tick(link, arrival, k)
            elif time.monotonic() - seen > FIRST_MEASUREMENT_S:
                return self._lose(f"no measurement for {FIRST_MEASUREMENT_S:g} s")
        return not self._role.stop.is_set()

    def _tick(self, link: ZenohLink, arrival: Arrival | None, k: int) -> None:
        command = self._controller.tick(arrival.frame if arrival else None, k)
        if command is not None:
            link.send(command)
            self._sent += 1
        self._ticks += 1
        if arrival is not None:
            self._received += 1
            if k % self._telemetry_every == 0 or self._state is not DaemonState.RUNNING:
                self._state = DaemonState.RUNNING
                self._publish_telemetry()
        self._publish_when_due()

    # ── the session ──

    def _new_controller(self) -> Controller:
        return Controller(self._wire, self._law, self._reference, self._loop.period)

    def _claim(self) -> ZenohLink | None:
        """Ask for the vehicle. The link is there before the question, so that the first measurement is not lost."""
        role = self._role
        claim = Claim(
            controller=role.name,
            session=uuid.uuid4().hex[:8],
            period_ns=self._loop.period_ns,
            lockstep=self._loop.lockstep,
            wire=self._wire,
        )
        link = ZenohLink(
            role.zenoh,
            send_key=topics.key("command", role.vehicle, session=claim.session),
            receive_key=topics.key("measurement", role.vehicle, session=claim.session),
            lossless=self._loop.lockstep,
        )
        answer = self._ask(claim)
        if isinstance(answer, Grant):
            self._refused += self._controller.refused
            self._saturated += self._controller.saturated
            self._controller = self._new_controller()
            self._session, self._state, self._told = claim.session, DaemonState.CLAIMED, ""
            role.event("claimed", f"{role.name} has {role.vehicle}", claim.session)
            return link
        link.close()
        if answer is not None and answer.reason != self._told:
            self._told = answer.reason
            role.event("refused", f"{role.vehicle} refuses: {answer.reason}", claim.session)
        return None

    def _ask(self, claim: Claim) -> Grant | Refusal | None:
        """The plant's answer, or None if there is no plant, or none that answers in time."""
        key = topics.key("claim", self._role.vehicle)
        for reply in self._role.zenoh.get(key, payload=claim.encode(), timeout=ANSWER_WAIT_S):
            if reply.ok is None:
                continue
            payload = reply.ok.payload.to_bytes()
            for model in (Grant, Refusal):
                try:
                    return model.model_validate_json(payload)
                except ValidationError:
                    continue
        return None

    def _lose(self, reason: str) -> bool:
        self._state = DaemonState.SEARCHING
        self._role.event("lost", f"{reason}: stopped commanding, looking for {self._role.vehicle}", self._session)
        return False

    def _release(self) -> None:
        """Give the session back, whether or not the plant still is there to take it."""
        if self._session is None:
            return
        release = Release(session=self._session)
        key = topics.key("release", self._role.vehicle)
        try:
            for _ in self._role.zenoh.get(key, payload=release.encode(), timeout=ANSWER_WAIT_S):
                pass
        except zenoh.ZError as error:
            log.warning("controller: could not release the session: %s", error)
        self._session = None

    def _token(self, name: str, came: bool) -> None:
        if name == "recorder":
            self._recorders = max(0, self._recorders + (1 if came else -1))

    # ── what it tells ──

    def _publish_telemetry(self) -> None:
        controller = self._controller
        assert self._session is not None
        self._role.publish(
            "telemetry",
            Telemetry(
                session=self._session,
                tick=controller.tick_index,
                counter=controller.counter,
                attitude_error=controller.attitude_error,
                rate_error=controller.rate_error,
                desired=controller.desired,
                damping_estimate=controller.damping_estimate,
                voltages=tuple(controller.voltages),
                sign=controller.sign,
            ),
        )

    def _publish_when_due(self) -> None:
        if time.monotonic_ns() >= self._status_due:
            self._publish_status()

    def _publish_status(self) -> None:
        now = time.monotonic()
        self._role.status(
            Status(
                role=self._role.role,
                state=self._state,
                session=self._session,
                uptime_s=self._role.uptime_s,
                ticks=self._ticks,
                rate_hz=(self._ticks - self._status_ticks) / (now - self._status_time),
                skipped=self._skipped,
                received=self._received,
                sent=self._sent,
                refused=self._refused + self._controller.refused,
                saturated=self._saturated + self._controller.saturated,
                notes=self._notes,
            )
        )
        self._status_ticks, self._status_time = self._ticks, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS


def controller_name() -> str:
    """A name for this controller that no other has: host names repeat, so a few random digits follow the process id."""
    return f"controller-{os.getpid()}-{uuid.uuid4().hex[:4]}"
