"""One session of the controller on a simulated link, which is the clock: how it runs, and each way in which it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import isnan
from typing import Any, cast

import pytest

from aeroloop import Now
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.states import ControllerState, ControllerTrigger
from aeroloop.protocol.messages.trace import Sent, read_batch
from aeroloop.protocol.runtime import node
from aeroloop.protocol.transport.link import Arrival, ZenohLink
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.config import load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import Floats
from aeroloop.service.daemon.session import Session, Shared
from tests.support.failing_laws import FAILING, Failing
from tests.support.operated_loop import LonelyNode, Network
from tests.support.simulated_link import PERIOD_NS, SimulatedLink

DELAY_NS = 200_000
SESSION = "s1"
WIRE = load().wire
AT_REST = [0] * 6
INVALID = [WIRE.attitude.quantizer().invalid] * 6


def arrival(k: int, codes: Iterable[float] = AT_REST) -> Arrival:
    return Arrival(WIRE.measurement.pack(k % WIRE.measurement.counters, [*codes]), k * PERIOD_NS + DELAY_NS)


class Plant(Network):
    def get(self, *_: object, **__: object) -> list[object]:
        return []


class Stage:
    """A granted session, the link that it uses, and all that it shares with other sessions."""

    def __init__(self, arrivals: Iterable[Arrival], *overrides: str) -> None:
        self.link = SimulatedLink([*arrivals], 1)
        self.network = Plant()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(node, "join", lambda *_: self.network)
            self.role = LonelyNode("controller", "aero", NetworkSettings(), {}, name="c", clock=self.link)
        settings = load(overrides=["loop.rate_hz=500", *overrides])
        self.shared = Shared(self.role, settings, lambda: "")
        self.shared.claims.session = SESSION
        self.role.declare("trace", 10)
        controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
        link = cast(ZenohLink, self.link)
        cast(Any, link).refused = 0
        self.published = 0
        self.session = Session(self.role, settings, self.shared, controller, link, self._publish)

    def _publish(self) -> None:
        self.published += 1

    def run(self) -> bool:
        finished = self.session.run()
        self.session.end()
        return finished

    @property
    def commands(self) -> list[list[float]]:
        read = [WIRE.command.unpack(frame) for _, frame in self.link.sent]
        return [[WIRE.voltage.quantizer().level(code) for code in codes] for _, codes in filter(None, read)]

    @property
    def rows(self) -> list[tuple[int, int]]:
        key = topics.key("trace", "aero", role="controller")
        batches = filter(None, (read_batch(payload) for at, payload in self.network.put if at == key))
        columns = [(batch.columns["tick"].tolist(), batch.columns["sent_as"].tolist()) for batch in batches]
        return [row for tick, sent_as in columns for row in zip(tick, sent_as, strict=True)]

    def status_of_plant(self, session: str, cause: str | None = None) -> None:
        status = Status(
            role="plant", state="idle", session=session, cause=cause, uptime_s=0, ticks=0, rate_hz=0, skipped=0
        )
        payload = type("Payload", (), {"to_bytes": lambda _: status.encode()})()
        waiting = self.network.received[topics.key("status", "aero", role="plant")]
        waiting.append(type("Sample", (), {"payload": payload})())


def test_every_measurement_is_answered_and_is_a_row_of_the_trace_until_the_duration_is_over() -> None:
    stage = Stage(map(arrival, range(100)), "controller.duration_s=0.1")
    assert stage.run()
    assert len(stage.commands) == 50
    assert stage.rows == [(k, Sent.FRAME) for k in range(50)]
    assert stage.shared.machine.state is ControllerState.RUNNING
    counts = stage.shared.counts
    assert (counts.ticks, counts.sent, counts.received, counts.skipped) == (50, 50, 50, 0)


def test_a_plant_that_falls_silent_is_given_up_and_nothing_more_is_sent() -> None:
    stage = Stage(map(arrival, range(10)), "controller.stale_s=0.1")
    assert not stage.run()
    assert stage.shared.machine.state is ControllerState.SEARCHING
    assert 0.1 <= stage.link.now_ns * 1e-9 - 9 * 0.002 < 0.1 + 0.03  # checked every 20 ms
    assert stage.shared.cause.startswith("no measurement for 1")
    assert len(stage.commands) == 10


def test_a_session_that_the_plant_ends_is_lost_with_the_plants_reason() -> None:
    stage = Stage([])
    stage.status_of_plant(SESSION)
    stage.status_of_plant("s2", "stopped by an operator")
    assert not stage.run()
    assert stage.shared.machine.state is ControllerState.SEARCHING
    assert stage.shared.cause == "the plant ended the session: stopped by an operator"


def test_a_measurement_without_a_valid_value_is_answered_by_none_until_there_is_one() -> None:
    stage = Stage([arrival(k, INVALID if k in (3, 4) else AT_REST) for k in range(8)], "controller.duration_s=0.016")
    assert stage.run()
    assert [any(map(isnan, volts)) for volts in stage.commands] == [k in (3, 4) for k in range(8)]
    assert stage.shared.machine.state is ControllerState.RUNNING


passing: list[Callable[[], None]] = []


class Dawdling(Failing):
    def step(self, now: Now[Floats]) -> Any:
        if now.state["ticks"] == 2:
            passing[-1]()
        return super().step(now)


@pytest.mark.parametrize(
    ("law", "cause", "valid", "invalid"),
    [
        (f"{__name__}:Dawdling", "took 0.3 s for a tick", 2, 0),  # a command computed too late is not sent
        (f"{FAILING}:Failing", "RuntimeError: the estimator", 3, 1),
    ],
)
def test_a_law_that_fails_or_takes_too_long_faults_the_controller_by_name(
    law: str, cause: str, valid: int, invalid: int
) -> None:
    stage = Stage(map(arrival, range(10)), f"law.kind={law}")
    passing.append(lambda: stage.link.advance(0.3))
    assert not stage.run()
    assert stage.shared.machine.state is ControllerState.FAULTED
    assert f"law {law}" in stage.shared.cause
    assert cause in stage.shared.cause
    assert [any(map(isnan, volts)) for volts in stage.commands] == [False] * valid + [True] * invalid


@pytest.mark.parametrize(
    "end",
    [lambda stage: stage.shared.machine.fire(ControllerTrigger.STAND_DOWN), lambda stage: stage.role.stop.set()],
    ids=["released by an operator", "stopped"],
)
def test_nothing_is_sent_from_the_tick_on_at_which_it_is_ended(end: Callable[[Stage], object]) -> None:
    stage = Stage(map(arrival, range(10)))
    stage.role.enqueue(lambda: end(stage))
    assert not stage.run()
    assert stage.commands == []
