"""One session of the controller on a simulated link, which is the clock: its claim, its run, and each way it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import isnan
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock, patch

import pytest

from aeroloop import Now
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Grant, Refusal, SessionRecord, Status, Telemetry
from aeroloop.protocol.messages.operator import Answer, Hold, Message, Track
from aeroloop.protocol.messages.states import ControllerState, ControllerTrigger
from aeroloop.protocol.messages.trace import Batch, Sent, read_batch
from aeroloop.protocol.runtime import node
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.link import Arrival, ZenohLink
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.config import load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import Floats
from aeroloop.service.daemon import claim
from aeroloop.service.daemon.claim import ClaimClient
from aeroloop.service.daemon.daemon import Daemon
from aeroloop.service.daemon.session import Session, Shared
from tests.support.failing_laws import FAILING, Failing
from tests.support.operated_loop import LonelyNode, Network, Query
from tests.support.plant_end import record_of
from tests.support.simulated_link import PERIOD_NS, SimulatedLink

DELAY_NS = 200_000
SESSION = "s1"
WIRE = load().wire
AT_REST = [0] * 6
MOVING = [0, 0, 0, 20, -20, 20]
INVALID = [WIRE.attitude.quantizer().invalid] * 6


def arrival(k: int, codes: Iterable[float] = AT_REST) -> Arrival:
    return Arrival(WIRE.measurement.pack(k % WIRE.measurement.counters, [*codes]), k * PERIOD_NS + DELAY_NS)


class Plant(Network):
    def liveliness(self) -> MagicMock:
        return MagicMock()

    def get(self, *_: object, **__: object) -> list[object]:
        return []


class Stage:
    """A granted session, the link that it uses, and all that it shares with other sessions."""

    def __init__(self, arrivals: Iterable[Arrival], *overrides: str) -> None:
        self.link = SimulatedLink([*arrivals], 1)
        self.network = Plant()
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(node, "join", lambda *_: self.network)
            self.role = LonelyNode("controller", "aero", NetworkSettings(), {}, name="c", clock=self.link)
        self.settings = settings = load(overrides=["loop.rate_hz=500", *overrides])
        self.shared = Shared(self.role, settings, lambda: "")
        self.shared.claims.session = SESSION
        self.role.declare("trace")
        link = self.session_link = cast(ZenohLink, self.link)
        cast(Any, link).refused = 0
        self.published = 0
        self.session = Session(self.role, settings, self.shared, self.fresh(), link, self._publish)

    def fresh(self) -> Controller:
        settings = self.settings
        return Controller(settings.wire, settings.law, settings.reference, settings.loop.period)

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
    def batches(self) -> list[Batch]:
        key = topics.key("trace", "aero", role="controller")
        return [*filter(None, (read_batch(payload) for at, payload in self.network.put if at == key))]

    @property
    def rows(self) -> list[tuple[int, int]]:
        columns = [(batch.columns["tick"].tolist(), batch.columns["sent_as"].tolist()) for batch in self.batches]
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


def test_a_status_of_the_session_before_ends_no_new_one() -> None:
    """The newest status is older than the claim, and the first measurement is late."""
    stage = Stage(
        [arrival(k)._replace(at_ns=50_000_000 + k * PERIOD_NS) for k in range(20)], "controller.duration_s=0.02"
    )
    stage.status_of_plant("s0", "released")
    assert stage.run()
    assert len(stage.commands) == 10


def test_each_batch_has_the_state_before_its_first_row() -> None:
    """From which a replay may begin, so a log that lacks some batches can still be computed again."""
    stage = Stage([arrival(k, MOVING) for k in range(300)], "controller.duration_s=0.5")
    assert stage.run()
    batches = [batch for batch in stage.batches if batch.header.rows]
    assert len(batches) >= 4
    again = stage.fresh()
    for batch in batches:
        assert batch.tail.state == again.state.model_dump(mode="json")
        changes = [*batch.tail.changes]
        for k in batch.columns["tick"].tolist():
            while changes and changes[0].tick <= k:
                again.apply(changes.pop(0))
            again.tick(arrival(k, MOVING).frame, k)


@pytest.mark.parametrize("by_datagrams", [True, False])
def test_the_link_of_datagrams_is_closed_with_the_session_that_used_it(by_datagrams: bool) -> None:
    """The next claim connects anew: the plant may be another one."""
    stage = Stage(map(arrival, range(10)))
    stage.shared.claims.by_datagrams = by_datagrams
    with patch.object(stage.role, "datagrams") as datagrams:
        stage.run()
        assert datagrams.close.called == by_datagrams


def test_each_session_begins_with_a_law_that_has_learned_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session is lost while the estimates move, and the vehicle is claimed again."""
    first = [arrival(k, MOVING) for k in range(150)]
    second = [arrival(k, MOVING)._replace(at_ns=450_000_000 + k * PERIOD_NS) for k in range(150)]
    stage = Stage([*first, *second], "loop.realtime=off")
    granted: list[str] = []

    def claim(client: ClaimClient) -> ZenohLink | None:
        stage.link.advance(0.001)
        if len(granted) == 2:
            stage.role.stop.set()
            return None
        granted.append(f"s{len(granted)}")
        client.session = granted[-1]
        return stage.session_link

    monkeypatch.setattr(ClaimClient, "claim", claim)
    Daemon(stage.role, stage.settings).run()
    assert granted == ["s0", "s1"]
    initial = stage.fresh().state.model_dump(mode="json")
    for session in granted:
        states = [batch.tail.state for batch in stage.batches if batch.header.session == session and batch.header.rows]
        assert states[0] == initial != states[-1]


def test_a_status_says_at_once_what_an_operator_has_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within its second: the session lasts 40 ms after the request."""
    law = f"law.kind={__name__}:Dawdling"
    stage = Stage(map(arrival, range(20)), law, "law.at=1000", "loop.realtime=off", "controller.duration_s=0.04")
    track = Query(topics.key("track", "aero"), Track(reference=Hold(attitude=(0.0, 0.0, 5.0))).encode())
    passing.append(lambda: stage.network.queryables[track.key_expr](track))

    def claim(client: ClaimClient) -> ZenohLink:
        stage.link.advance(0.001)
        client.session = SESSION
        return stage.session_link

    monkeypatch.setattr(ClaimClient, "claim", claim)
    Daemon(stage.role, stage.settings).run()
    assert track.answers[0].done
    key = topics.key("status", "aero", role="controller")
    statuses = [Status.model_validate_json(payload) for at, payload in stage.network.put if at == key]
    assert "roll, pitch, yaw 0°, 0°, 5°" in {status.reference for status in statuses if status.session == SESSION}


def test_a_measurement_without_a_valid_value_is_answered_by_none_until_there_is_one() -> None:
    stage = Stage([arrival(k, INVALID if k in (3, 4) else AT_REST) for k in range(8)], "controller.duration_s=0.016")
    assert stage.run()
    assert [any(map(isnan, volts)) for volts in stage.commands] == [k in (3, 4) for k in range(8)]
    assert stage.shared.machine.state is ControllerState.RUNNING


def test_without_any_valid_value_from_the_start_the_controller_is_ready_and_says_so_once() -> None:
    stage = Stage([arrival(k, INVALID) for k in range(20)], "controller.duration_s=0.04")
    assert stage.run()
    assert stage.shared.machine.state is ControllerState.READY
    key = topics.key("event", "aero", role="controller")
    events = [Event.model_validate_json(payload) for at, payload in stage.network.put if at == key]
    assert [event.text for event in events if event.kind == "fault"] == [
        "no valid measurement: commands no valid value"
    ]


def test_telemetry_is_published_ten_times_a_second() -> None:
    stage = Stage(map(arrival, range(200)), "controller.duration_s=0.4")
    assert stage.run()
    key = topics.key("telemetry", "aero", role="controller")
    published = [Telemetry.model_validate_json(payload) for at, payload in stage.network.put if at == key]
    assert [telemetry.tick for telemetry in published] == [0, 50, 100, 150]


passing: list[Callable[[], None]] = []


class Dawdling(Failing):
    def step(self, now: Now[Floats]) -> Any:
        if now.state["ticks"] == 2:
            passing[-1]()
        return super().step(now)


@pytest.mark.parametrize(
    ("law", "cause", "valid", "invalid"),
    [
        (f"{__name__}:Dawdling", "took 0.3 s of CPU time for a tick", 2, 0),  # a command computed too late is not sent
        (f"{FAILING}:Failing", "RuntimeError: the estimator", 3, 1),
    ],
)
def test_a_law_that_fails_or_takes_too_long_faults_the_controller_by_name(
    law: str, cause: str, valid: int, invalid: int
) -> None:
    stage = Stage(map(arrival, range(10)), f"law.kind={law}")
    passing.append(lambda: stage.link.compute(0.3))
    assert not stage.run()
    assert stage.shared.machine.state is ControllerState.FAULTED
    assert f"law {law}" in stage.shared.cause
    assert cause in stage.shared.cause
    assert [any(map(isnan, volts)) for volts in stage.commands] == [False] * valid + [True] * invalid


def test_a_law_that_the_host_halts_in_a_tick_goes_on_and_is_no_fault() -> None:
    """As by SIGSTOP: time passes, but none of it on a CPU. The plant's watchdog judges the lateness."""
    stage = Stage(map(arrival, range(300)), f"law.kind={__name__}:Dawdling", "law.at=1000", "controller.duration_s=0.5")
    passing.append(lambda: stage.link.advance(0.13))
    assert stage.run()
    assert stage.shared.machine.state is ControllerState.RUNNING
    assert stage.rows[:3] == [(k, Sent.FRAME) for k in range(3)]
    assert stage.rows[3][0] > 3 + 0.12 / 0.002  # what came meanwhile is missed, but for the newest


def test_in_lockstep_a_law_may_take_its_time() -> None:
    law = f"law.kind={__name__}:Dawdling"
    arrivals = [arrival(k)._replace(at_ns=k * 1_000_000_000) for k in range(10)]
    stage = Stage(arrivals, law, "law.at=1000", "loop.lockstep=true", "controller.duration_s=0.02")
    passing.append(lambda: stage.link.advance(0.3))
    assert stage.run()
    assert len(stage.commands) == 10


def test_frames_and_not_silent_ticks_count_as_received_and_what_a_link_refused_stays_counted() -> None:
    sparse = ["wire.transmit.measurement=on_change", "wire.transmit.heartbeat_s=0.01"]
    stage = Stage([arrival(k) for k in range(0, 50, 5)], *sparse, "controller.duration_s=0.08")
    cast(Any, stage.link).refused = 3
    assert stage.run()
    counts = stage.shared.counts
    assert (counts.ticks, counts.received, counts.refused) == (40, 8, 3)


def test_of_a_flood_of_statuses_one_is_read_in_ten_milliseconds() -> None:
    stage = Stage([])
    for number in range(3):
        stage.status_of_plant(f"s{number}")
    for number in range(3):
        statuses = [stage.shared.plant.read() for _ in range(5)]
        assert [status and status.session for status in statuses] == [f"s{number}"] * 5
        stage.link.advance(0.01)


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


# ── claims, controller side: every record reaches the plant, and frames travel by what the plant takes ──


def claims_of(zenoh: Any, **role: Any) -> ClaimClient:
    """The claims of a controller on a network."""
    known = {"vehicle": "aero", "name": "c", "datagrams": SimpleNamespace(wanted=False)}
    node = cast(Node, SimpleNamespace(zenoh=zenoh, **known | role))
    return ClaimClient(node, LoopSettings(), WireSpec(), auto_arm=False)


def test_a_record_is_encoded_once_however_often_it_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded, sent = list[SessionRecord](), list[bytes]()
    encode = SessionRecord.encode

    def counted(record: SessionRecord) -> bytes:
        encoded.append(record)
        return encode(record)

    monkeypatch.setattr(SessionRecord, "encode", counted)
    claims = claims_of(SimpleNamespace(get=lambda *_, payload, **__: sent.append(payload)))
    claims.session = "s"
    first, second = record_of("c"), record_of("c", within_s=5.0)
    for record in (first, first, first, second, second):
        claims.keep(record)
    assert [SessionRecord.model_validate_json(payload) for payload in sent] == [first] * 3 + [second] * 2
    assert encoded == [first, second]


def test_a_record_is_sent_until_the_plant_has_answered_and_then_only_when_it_changes() -> None:
    sent = list[tuple[str, SessionRecord]]()
    handlers = list[Callable[[Any], None]]()

    def get(key: str, handler: Callable[[Any], None], *, payload: bytes, **_: object) -> None:
        sent.append((key, SessionRecord.model_validate_json(payload)))
        handlers.append(handler)

    def reply(answer: Answer) -> None:
        handlers[-1](SimpleNamespace(ok=SimpleNamespace(payload=_bytes(answer.encode()))))

    claims = claims_of(SimpleNamespace(get=get))
    first, second = record_of("c"), record_of("c", within_s=5.0)
    claims.keep(first)
    assert sent == []  # no session runs
    claims.session = "s"
    claims.keep(first)
    claims.keep(first)
    handlers[-1](SimpleNamespace(ok=None))  # a time-out
    claims.keep(first)
    assert sent == [(topics.key("record", "aero"), first)] * 3
    reply(Answer(done=False, text="busy"))
    claims.keep(first)
    assert sent[3:] == [(topics.key("record", "aero"), first)]
    reply(Answer(done=True, text="kept"))
    claims.keep(first)
    assert len(sent) == 4
    claims.keep(second)
    assert sent[4:] == [(topics.key("record", "aero"), second)]


def test_a_session_is_released_once() -> None:
    released: list[str] = []

    def get(key: str, **_: object) -> list[object]:
        released.append(key)
        return []

    claims = claims_of(SimpleNamespace(get=get))
    claims.release()
    assert released == []
    claims.session = "s"
    claims.release()
    claims.release()
    assert released == [topics.key("release", "aero")]


class AnsweringPlant:
    def __init__(self, status: bytes | None, claim: Message | None = None) -> None:
        answer = (claim or Grant(session="s")).encode()
        self.answers = {} if status is None else {"status": status, "claim": answer}

    def get(self, key: str, **_: object) -> list[SimpleNamespace]:
        answers = [answer for topic, answer in self.answers.items() if f"/{topic}" in key]
        timed_out = [SimpleNamespace(ok=None)]  # Zenoh's reply for a query that is not answered in time
        return [SimpleNamespace(ok=SimpleNamespace(payload=_bytes(answer))) for answer in answers] or timed_out


def test_a_refusal_is_an_event_once_and_stays_known_until_a_grant(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that an operator's request can be answered with it: "stopped; `op arm` clears it"."""
    link, events = SimpleNamespace(close=lambda: None), list[str]()
    monkeypatch.setattr(claim, "ZenohLink", lambda *_, **__: link)
    plant = AnsweringPlant(b"", Refusal(reason="stopped"))
    claims = claims_of(plant, event=lambda _kind, text, _session: events.append(text))
    for _ in range(3):
        assert claims.claim() is None
        assert (claims.refusal, events) == ("stopped", ["aero refuses: stopped"])
    plant.answers["claim"] = Grant(session="s").encode()
    assert claims.claim() is not None
    assert claims.refusal == ""


def _bytes(payload: bytes) -> SimpleNamespace:
    return SimpleNamespace(to_bytes=lambda: payload)  # as Zenoh hands them over


@pytest.mark.parametrize(
    ("endpoint", "passes", "carrier"),
    [
        ("udp/h:1", True, "datagrams"),
        ("udp/h:1", False, "first"),
        ("udp/h:1", None, "none"),
        ("", True, "first"),
        (None, True, "none"),
    ],
    ids=["it takes datagrams", "none pass", "not linked yet", "it takes none", "no plant answers"],
)
def test_a_claims_frames_travel_by_datagrams_where_the_plant_takes_them(
    monkeypatch: pytest.MonkeyPatch, endpoint: str | None, passes: bool | None, carrier: str
) -> None:
    status = None if endpoint is None else Status(
        role="plant", state="idle", uptime_s=0, ticks=0, rate_hz=0, skipped=0, datagrams=endpoint
    ).encode()  # fmt: skip
    first, datagrams, warned = AnsweringPlant(status), SimpleNamespace(name="datagrams"), []
    asked = SimpleNamespace(wanted=True, linked=False, connect=lambda _: passes, session=datagrams)
    used: list[object] = []

    def link(session: object, **_: object) -> object:
        used.append(session)
        return object()

    monkeypatch.setattr(claim, "ZenohLink", link)
    claims = claims_of(first, datagrams=asked, warn=lambda *words: warned.append(words[-1]))
    assert (claims.claim() is not None) == (carrier != "none")
    assert used == {"datagrams": [datagrams], "first": [first], "none": []}[carrier]
    assert claims.by_datagrams == (carrier == "datagrams")
    assert bool(warned) == (passes is False)
