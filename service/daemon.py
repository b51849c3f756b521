"""The controller process: claim a vehicle, then wait → tick → send → account, until told to stop.

The plant's clock leads: a tick is due when its measurement arrives. In lockstep the very same loop runs as fast as the
plant asks. Whenever the daemon has no session it claims again, four times a second, so either end may start first and
either may be restarted. When measurements stop coming for longer than `stale_s` it gives the session up and says
nothing more; the plant's watchdog does the rest.
"""

from __future__ import annotations

import logging
import os
import time
import uuid
from enum import StrEnum
from typing import Final

import zenoh
from pydantic import ValidationError

from protocol import topics
from protocol.clock import LoopSettings, LoopTiming, prepare_process
from protocol.errors import AeroloopError
from protocol.frames import TickCounter, WireSpec
from protocol.links import ZenohLink
from protocol.messages import Claim, Grant, Refusal, Release, Status, Telemetry, report
from protocol.role import Role
from service.controller import Controller
from service.law import LawSettings
from service.reference import SinusoidSettings, reference_function
from service.settings import ControllerSettings

log: Final = logging.getLogger("aeroloop")

STATUS_PERIOD_NS: Final = 1_000_000_000
CLAIM_PERIOD_S: Final = 0.25
ANSWER_WAIT_S: Final = 1.0
LOCKSTEP_PATIENCE_S: Final = 2.0
"""In lockstep the plant takes its time; only a plant that is gone is stale."""


class SessionLostError(AeroloopError):
    """A run of a given duration lost its session before its end; to claim again would start the law's time anew."""


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
        self._patience_s = max(LOCKSTEP_PATIENCE_S, settings.stale_s) if loop.lockstep else settings.stale_s
        self._last_tick = loop.ticks(settings.duration_s) - 1 if settings.duration_s else None
        self._telemetry_every = max(1, round(loop.rate_hz / settings.telemetry_rate_hz))
        self._state = DaemonState.SEARCHING
        self._session: str | None = None
        self._recorders = 0
        self._told = self._lost = ""
        self._sent = self._received = self._skipped = self._refused = self._saturated = 0
        self._notes: list[str] = []
        self._timing: LoopTiming | None = None
        self._status_due = 0
        self._status_ticks = 0
        self._status_time = time.monotonic()

    def run(self) -> None:
        """Run until the role is told to stop or `duration_s` of the law's time are over."""
        if not self._loop.lockstep:
            self._notes = prepare_process(self._loop)
            self._timing = LoopTiming()
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
                    finished = self._run(link)
                finally:
                    self._release()
                    link.close()
                if not finished and self._last_tick is not None and not self._role.stop.is_set():
                    raise SessionLostError(
                        f"{self._lost} after {self._controller.tick_index + 1} ticks, so the run is over; "
                        "a machine too busy for real time can still run it in lockstep"
                    )
        finally:
            self._state = DaemonState.HOLDING
            self._role.event("stopped", f"{self._role.name} stopped commanding")
            self._publish_status()

    def _run(self, link: ZenohLink) -> bool:
        """One session: a tick for every measurement. True once the duration is over, False if the session was lost.

        The plant counts its measurements from 0 at the grant, so its counter is the law's tick, even after a gap.
        """
        controller, stop = self._controller, self._role.stop
        ticks = TickCounter(self._loop.period_ns, lockstep=self._loop.lockstep)
        k, heard = -1, time.monotonic()
        while not stop.is_set() and (self._last_tick is None or k < self._last_tick):
            arrival = link.wait(self._settings.stale_s)
            if arrival is None:
                if time.monotonic() - heard > self._patience_s:
                    return self._lose(f"no measurement for {(time.monotonic() - heard) * 1e3:.0f} ms")
                continue
            if self._timing:
                self._timing.woke(arrival.at_ns)
            heard = time.monotonic()
            read = self._wire.measurement.unpack(arrival.frame)
            # What is malformed counts as the measurement that was due, and is refused by the controller.
            measured = k + 1 if read is None else ticks.advance(read[0], arrival.published_ns)
            if measured is None:
                continue
            command = controller.tick(arrival.frame, measured)
            if command is not None:
                link.send(command)
            self._account(command, measured, max(0, measured - k - 1))
            k = measured
            if self._timing:
                self._timing.done()
        return not stop.is_set()

    def _account(self, command: bytes | None, measured: int, missed: int) -> None:
        self._received += 1
        self._skipped += missed
        if command is not None:
            self._sent += 1
        if self._controller.tick_index == measured:  # it used the measurement
            if self._state is not DaemonState.RUNNING:
                self._state = DaemonState.RUNNING
                self._publish_telemetry()
                self._role.event("claimed", f"{self._role.name} has {self._role.vehicle}", self._session)
            elif measured % self._telemetry_every == 0:
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
            auto_arm=self._settings.auto_arm,
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
        if self._timing:
            self._timing.pause()
        self._state, self._lost = DaemonState.SEARCHING, reason
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
                ticks=self._received,
                rate_hz=(self._received - self._status_ticks) / (now - self._status_time),
                skipped=self._skipped,
                received=self._received,
                sent=self._sent,
                refused=self._refused + self._controller.refused,
                saturated=self._saturated + self._controller.saturated,
                timing=report(self._timing) if self._timing else None,
                notes=self._notes,
            )
        )
        self._status_ticks, self._status_time = self._received, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS


def controller_name() -> str:
    """A name for this controller that no other has: host names repeat, so a few random digits follow the process id."""
    return f"controller-{os.getpid()}-{uuid.uuid4().hex[:4]}"
