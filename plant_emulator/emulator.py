"""The emulator process: an emulated plant behind an Endpoint, on the network.

The loop is wait → receive → tick → send → account. In real time it waits for the grid; in lockstep it waits for the
answer to its last measurement, so that a run repeats bit for bit. Claims, releases and lost peers come from Zenoh's
threads and wait in a queue for the loop to take them between ticks: the endpoint is only ever touched by one thread.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final

import zenoh
from pydantic import ValidationError

from plant_emulator.endpoint import Endpoint
from plant_emulator.settings import PlantSettings
from protocol import topics
from protocol.clock import Histogram, LoopSettings, LoopTiming, TickGrid, prepare_process
from protocol.frames import COUNTERS, WireSpec
from protocol.links import Arrival, ZenohLink
from protocol.messages import Claim, Grant, Refusal, Release, Status, Truth, report, summary
from protocol.role import Role

STATUS_PERIOD_NS: Final = 1_000_000_000
IDLE_WAIT_S: Final = 0.02


class Emulator:
    """The plant end as a process.

    Args:
        role: Its presence on the network.
        loop: The grid.
        wire: How frames are read and written.
        settings: The plant.
    """

    def __init__(self, role: Role, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
        self._role = role
        self._loop = loop
        self._settings = settings
        self._plant = settings.build(loop.period)
        self._endpoint = Endpoint(
            self._plant,
            wire,
            loop.period_ns,
            lockstep=loop.lockstep,
            watchdog_s=settings.watchdog_s,
            guard=settings.guard(loop.period_ns, wire.voltage.quantizer().outermost),
            armed=settings.armed_at_start,
        )
        self._link: ZenohLink | None = None
        self._inbox: deque[Callable[[], None]] = deque()
        self._latency = Histogram()
        self._timing: LoopTiming | None = None
        self._sent_at = [0] * COUNTERS
        self._sent = self._received = self._skipped = 0
        self._notes: list[str] = []
        self._k = -1
        self._status_due = 0
        self._status_tick = 0
        self._status_time = time.monotonic()
        self._truth_every = round(loop.rate_hz / settings.truth_rate_hz) if settings.truth_rate_hz else 0

    def run(self) -> None:
        """Run until the role is told to stop; then 0 V and a last status."""
        role = self._role
        role.answer(topics.key("claim", role.vehicle), lambda q: self._inbox.append(lambda: self._claim(q)))
        role.answer(topics.key("release", role.vehicle), lambda q: self._inbox.append(lambda: self._release(q)))
        role.answer(topics.key("arm", role.vehicle), lambda q: self._inbox.append(lambda: self._arm(q)))
        role.answer(topics.key("stop", role.vehicle), lambda q: self._inbox.append(lambda: self._stop(q)))
        role.watch_tokens(self._token)
        role.announce()
        role.event("started", f"{role.vehicle} waits for a claim")
        try:
            if self._loop.lockstep:
                self._run_lockstep()
            else:
                self._run_real_time()
        finally:
            self._plant.close()
            self._follow_session()
            role.event("stopped", f"{role.vehicle} stopped at 0 V")
            self._publish_status()

    def _run_real_time(self) -> None:
        self._notes = prepare_process(self._loop)
        timing = self._timing = LoopTiming()
        grid = TickGrid(self._loop.period_ns)
        while not self._role.stop.is_set():
            skipped = grid.skipped
            k = grid.wait()
            timing.woke(grid.due_ns)
            self._take_inbox()
            arrival = self._link.take() if self._link else None
            frame = self._endpoint.tick(arrival.frame if arrival else None, k)
            if frame is not None and self._link:
                self._send(frame)
            if self._endpoint.session:
                self._skipped += grid.skipped - skipped
            self._account(k, arrival)
            timing.done()

    def _run_lockstep(self) -> None:
        arrival = None
        while not self._role.stop.is_set():
            self._take_inbox()
            if self._link is None:
                time.sleep(IDLE_WAIT_S)
                self._publish_when_due()
                continue
            frame = self._endpoint.tick(arrival.frame if arrival else None, self._k + 1)
            arrival = None
            if frame is not None:
                self._send(frame)
                arrival = self._await_answer()
            self._account(self._k + 1, arrival)

    def _await_answer(self) -> Arrival | None:
        """The next command, or None when the session ends before one comes."""
        deadline = time.monotonic() + self._settings.answer_timeout_s
        while self._link and not self._role.stop.is_set():
            if (arrival := self._link.wait(IDLE_WAIT_S)) is not None:
                return arrival
            self._take_inbox()
            if time.monotonic() > deadline:
                self._endpoint.expire(f"no answer for {self._settings.answer_timeout_s:g} s")
            self._follow_session()
            self._publish_when_due()
        return None

    def _send(self, frame: bytes) -> None:
        assert self._link is not None
        self._sent_at[self._endpoint.counter] = time.monotonic_ns()
        self._link.send(frame)
        self._sent += 1

    def _account(self, k: int, arrival: Arrival | None) -> None:
        self._k = k
        if arrival is not None:
            self._received += 1
            read = self._endpoint.wire.command.unpack(arrival.frame)
            if read is not None and (elapsed := arrival.at_ns - self._sent_at[read[0]]) > 0:
                self._latency.add(elapsed)
        self._follow_session()
        if self._truth_every and k % self._truth_every == 0:
            state = self._plant.truth()
            self._role.publish(
                "truth", Truth(tick=k, attitude=state.attitude, rate=state.rate, voltages=state.voltages)
            )
        self._publish_when_due()

    def _publish_when_due(self) -> None:
        if time.monotonic_ns() >= self._status_due:
            self._publish_status()

    # ── what came from Zenoh's threads, taken between ticks ──

    def _token(self, name: str, came: bool) -> None:
        if not came:
            self._inbox.append(lambda: self._endpoint.lost(name))

    def _take_inbox(self) -> None:
        while self._inbox:
            self._inbox.popleft()()
            self._follow_session()

    def _claim(self, query: zenoh.Query) -> None:
        answer: Grant | Refusal
        try:
            claim = Claim.model_validate_json(query.payload.to_bytes() if query.payload else b"")
        except ValidationError as error:
            answer = Refusal(reason=f"not a claim: {error.errors()[0]['msg']}")
        else:
            answer = self._endpoint.claim(claim)
            if isinstance(answer, Grant):
                self._open_link(claim.session)
            else:
                self._role.event("refused", f"{claim.controller} refused: {answer.reason}", claim.session)
        query.reply(query.key_expr, answer.encode())
        query.drop()

    def _release(self, query: zenoh.Query) -> None:
        try:
            release = Release.model_validate_json(query.payload.to_bytes() if query.payload else b"")
        except ValidationError:
            released = False
        else:
            released = self._endpoint.release(release.session)
        query.reply(query.key_expr, b"true" if released else b"false")
        query.drop()

    def _arm(self, query: zenoh.Query) -> None:
        query.reply(query.key_expr, b"true" if self._endpoint.arm() else b"false")
        query.drop()

    def _stop(self, query: zenoh.Query) -> None:
        self._endpoint.stop()
        query.reply(query.key_expr, b"true")
        query.drop()

    def _open_link(self, session: str) -> None:
        """Listen for commands before the grant goes out, so that the first one finds somebody."""
        vehicle = self._role.vehicle
        self._link = ZenohLink(
            self._role.zenoh,
            send_key=topics.key("measurement", vehicle, session=session),
            receive_key=topics.key("command", vehicle, session=session),
            lossless=self._loop.lockstep,
        )

    def _follow_session(self) -> None:
        """Tell what happened, and close the link of a session that ended."""
        if self._endpoint.session is None and self._link is not None:
            self._link.close()
            self._link = None
        if self._endpoint.notices:
            for notice in self._endpoint.notices:
                self._role.event(*notice)
            self._endpoint.notices.clear()
            self._status_due = 0

    def _publish_status(self) -> None:
        now = time.monotonic()
        endpoint = self._endpoint
        self._role.status(
            Status(
                role=self._role.role,
                state=endpoint.state,
                session=endpoint.session,
                cause=endpoint.cause,
                uptime_s=self._role.uptime_s,
                ticks=self._k + 1,
                rate_hz=max(0.0, (self._k - self._status_tick) / (now - self._status_time)),
                skipped=self._skipped,
                received=self._received,
                sent=self._sent,
                refused=endpoint.refused,
                saturated=endpoint.saturated,
                latency_us=summary(self._latency),
                timing=report(self._timing) if self._timing else None,
                notes=self._notes,
            )
        )
        self._status_tick, self._status_time = self._k, now
        self._status_due = time.monotonic_ns() + STATUS_PERIOD_NS
