"""Operator's changes to a running loop: each takes effect at the published tick, and the log replays.

A real Role on a double of the network: outgoing messages are kept as bytes, incoming ones are fed through the declared
callbacks. Time stands still unless the test moves it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import accumulate
from math import acos, atan2, degrees, hypot, radians, sin
from typing import Any, Final, TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, SessionRecord
from aeroloop.protocol.messages.operator import (
    Answer,
    Change,
    Gains,
    Hold,
    Message,
    Points,
    Reference,
    Setpoint,
    Sinusoid,
    Stream,
    Track,
)
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime import role, throttle
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.network import NetworkSettings
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.law import LawSettings
from aeroloop.service.daemon import operator_changes as live
from aeroloop.service.daemon.certificate_gate import CertificateGate
from aeroloop.service.daemon.operator_changes import OperatorChanges
from aeroloop.service.settings import ControllerSettings

PERIOD = 0.002
LAW = LawSettings()
LEVEL = Hold(attitude=(0.0, 0.0, 0.0))
CONFIGURED = ControllerSettings(after_restart="configured")
"""Which session begins with what: test_session_start.py."""
WIRE = WireSpec(
    attitude=SignalSpec(bits=None, limit=1.0),
    rate=SignalSpec(bits=None, limit=5.0),
    voltage=SignalSpec(bits=None, limit=1e9),
)
"""Unquantized and hardly limited: a command says the last bit of what the law computes."""
NO_VALID_VALUE: Final = [float("nan")] * 6
M = TypeVar("M", bound=Message)

# The network and the time


class Payload:
    """Bytes as Zenoh hands them over."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload

    def to_bytes(self) -> bytes:
        """The bytes."""
        return self.payload


class Sample:
    """What a subscriber is called with."""

    def __init__(self, payload: bytes) -> None:
        self.payload = Payload(payload)


class Query:
    """What a queryable is called with; keeps what it is answered."""

    def __init__(self, key: str, payload: bytes) -> None:
        self.key_expr = key
        self.payload = Payload(payload)
        self.answers: list[Answer] = []

    def reply(self, key: str, payload: bytes) -> None:
        """An answer comes."""
        assert key == self.key_expr
        self.answers.append(Answer.model_validate_json(payload))

    def drop(self) -> None:
        """No further answer will come."""


class Network:
    """A Zenoh session without any other: it keeps what is declared and what is put."""

    def __init__(self) -> None:
        self.put: list[tuple[str, bytes]] = []
        self.queryables: dict[str, Callable[[Any], None]] = {}
        self.subscribers: dict[str, Callable[[Any], None]] = {}

    def declare_queryable(self, key: str, callback: Callable[[Any], None], *, complete: bool) -> None:
        """Keep the callback."""
        assert complete
        self.queryables[key] = callback

    def declare_subscriber(self, key: str, callback: Callable[[Any], None]) -> None:
        """Keep the callback."""
        self.subscribers[key] = callback

    def close(self) -> None:
        """Nothing to close."""


class Publisher:
    """Puts on the network."""

    id = None

    def __init__(self, network: Network, key: str) -> None:
        self.network = network
        self.key = key

    def put(self, payload: bytes) -> None:
        """Keep the bytes."""
        self.network.put.append((self.key, payload))


class LonelyRole(Role):
    """A role whose publications stay on the network of the test."""

    def declare(self, topic: str, per_s: float, *, lossless: bool = False) -> None:
        """Something to put on a key."""
        del per_s, lossless
        key = topics.key(topic, self.vehicle, role=self.role)
        self._publishers[topic] = Publisher(self.zenoh, key)  # type: ignore[assignment,arg-type]  # of the test


class FakeTime:
    """A clock that moves only when set."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        """The time [s]."""
        return self.now


class Loop:
    """What the daemon does around OperatorChanges, with a log of what a recorder would have kept.

    Attributes:
        k: The next tick.
        session: Name of the session, or "".
        log: Of each session, its frames: (tick, measurement, command).
        assurance: What the theorem promises of it by a wire; OperatorChanges asks for it if a wire is given.
    """

    def __init__(
        self, reference: Reference, settings: ControllerSettings, *, rolls: bool = False, wire: WireSpec | None = None
    ) -> None:
        with pytest.MonkeyPatch.context() as patch:
            self.network = Network()
            patch.setattr(role, "join", lambda _: self.network)
            self.role = LonelyRole("controller", "aero", NetworkSettings(), {}, name="controller-7")
        self.configured = reference
        self.assurance = CertificateGate(self.role, wire or WIRE, LAW, reference, settings)
        self.trace = TraceWriter("controller", WIRE, 1, 10**8)
        self.live = OperatorChanges(
            self.role, LAW, reference, settings, self.trace, self.assurance if wire else None, rolls=rolls
        )
        self.live.serve()
        self.controller = self.fresh()
        self.k = 0
        self.session = ""
        self.log: dict[str, list[tuple[int, bytes, bytes | None]]] = {}

    def fresh(self) -> Controller:
        """A controller as the configuration makes it."""
        return Controller(WIRE, LAW, self.configured, PERIOD)

    # The loop

    def begin(self, last: SessionRecord | None = None) -> None:
        """A session is granted, with the plant's record of the one before."""
        self.session = f"s{len(self.log)}"
        self.log[self.session] = []
        self.controller, self.k = self.fresh(), 0
        self.live.begin(self.controller, self.session, last)

    def end(self) -> None:
        """The session is over."""
        self.live.end()
        self.session = ""

    def tick(self, codes: list[float] | None = None) -> bytes | None:
        """A measurement comes, at rest and level unless given, and is answered."""
        frame = WIRE.measurement.pack(self.k % WIRE.measurement.counters, codes or [0.0] * 6)
        self.live.before_tick(self.k, frame)
        command = self.controller.tick(frame, self.k)
        self.log[self.session].append((self.k, frame, command))
        self.k += 1
        return command

    def run(self, seconds: float) -> None:
        """Many ticks."""
        for _ in range(round(seconds / PERIOD)):
            self.tick()

    def malformed(self) -> None:
        """Something comes that is no measurement; the daemon counts it as the one that was due."""
        self.live.before_tick(self.k, b"junk")
        assert self.controller.tick(b"junk", self.k) is None

    # The operator

    def ask(self, topic: str, message: Message | bytes) -> Query:
        """Put a question; it is answered between two ticks."""
        key = topics.key(topic, "aero")
        query = Query(key, message if isinstance(message, bytes) else message.encode())
        self.network.queryables[key](query)
        return query

    def stream(self, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> None:
        """A set-point comes [deg]."""
        self.raw(Setpoint(attitude=(roll, pitch, yaw)).encode())

    def raw(self, payload: bytes) -> None:
        """Bytes come where set-points should."""
        self.network.subscribers[topics.key("reference", "aero")](Sample(payload))

    # What was published

    def published(self, topic: str, model: type[M]) -> list[M]:
        """Every message on a topic."""
        key = topics.key(topic, "aero", role="controller")
        return [model.model_validate_json(payload) for at, payload in self.network.put if at == key]

    def changes(self) -> list[Change]:
        """Every change of this session, as a log has it."""
        return [change for change in self.trace.changes if change.session == self.session]

    def events(self, kind: str) -> list[str]:
        """The texts of a kind that were published."""
        return [event.text for event in self.published("event", Event) if event.kind == kind]

    def yaw(self) -> float:
        """Of q_d at the last tick, level [deg]."""
        w, x, y, z = self.controller.desired
        assert (x, y) == (0.0, 0.0)
        return degrees(2 * atan2(z, w))

    def assert_it_runs_again(self) -> None:
        """From the configuration, the frames and the changes, as the review does: byte for byte."""
        for session, ticks in self.log.items():
            again = self.fresh()
            logged = [change.encode() for change in self.trace.changes if change.session == session]
            changes = [Change.model_validate_json(text) for text in logged]
            for k, frame, command in ticks:
                while changes and changes[0].tick <= k:
                    again.apply(changes.pop(0))
                assert again.tick(frame, k) == command, f"{session}, tick {k}"


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    """The fake clock in place of `time` wherever it is looked at."""
    fake = FakeTime()
    for module in (throttle, role, live):
        monkeypatch.setattr(module, "time", fake)
    return fake


@pytest.fixture
def loop(time: FakeTime) -> Iterable[Loop]:  # noqa: ARG001  # the clock must stand still before OperatorChanges looks at it
    """A session at tick 0, level; whatever a test does to it, its log must run again."""
    loop = Loop(LEVEL, CONFIGURED)
    loop.begin()
    yield loop
    loop.assert_it_runs_again()


LATER_TOO_FAST = Points(
    times=[0.0, 1.0, 2.0, 2.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 2.0, 0.0), (0.0, 2.0, 40.0)]
)

# Gains


def test_gains_hold_from_the_very_tick_that_is_published(loop: Loop) -> None:
    alone = loop.fresh()
    tilted = [0.0, 0.1, 0.0, 0.0, 0.3, -0.2]
    frames = [WIRE.measurement.pack(k, tilted) for k in range(10)]
    for frame in frames[:7]:
        assert loop.tick(tilted) == alone.tick(frame, loop.k - 1)
    asked = loop.ask("set_gains", Gains(C1=(1.0, 1.0, 1.0), Gamma=(0.5, 0.5, 0.5)))
    assert not asked.answers  # not before the loop comes by
    command = loop.tick(tilted)
    unchanged = loop.fresh()
    for k, frame in enumerate(frames[:7]):
        unchanged.tick(frame, k)
    alone.set_gains(Gains(C1=(1.0, 1.0, 1.0), Gamma=(0.5, 0.5, 0.5)))
    assert command == alone.tick(frames[7], 7) != unchanged.tick(frames[7], 7)
    (answer,) = asked.answers
    assert answer.done
    assert "C1 = [1.0, 1.0, 1.0]" in answer.text
    start, change = loop.changes()
    assert (start.tick, start.gains) == (0, Gains(C1=LAW.C1, C2=LAW.C2, Gamma=LAW.Gamma))
    assert change == Change(session="s0", tick=7, gains=Gains(C1=(1.0, 1.0, 1.0), Gamma=(0.5, 0.5, 0.5)))
    assert loop.controller.gains == Gains(C1=(1.0, 1.0, 1.0), C2=LAW.C2, Gamma=(0.5, 0.5, 0.5))


def test_no_gain_changes_none_and_the_reply_states_it(loop: Loop) -> None:
    asked = loop.ask("set_gains", Gains())
    loop.tick()
    assert "none has changed" in asked.answers[0].text
    assert loop.controller.gains == Gains(C1=LAW.C1, C2=LAW.C2, Gamma=LAW.Gamma)


@pytest.mark.parametrize(
    ("topic", "payload", "why"),
    [
        ("set_gains", b'{"C1": [0.3, 0.3, 300]}', "at most 20"),
        ("set_gains", b'{"C9": [1, 1, 1]}', "Gains"),
        ("set_gains", b"gains, please", "Gains"),
        ("track", b'{"reference": {"kind": "dance"}}', "Track"),
        ("track", b"", "Track"),
        ("track", Track(reference=Hold(attitude=(0.0, 61.0, 0.0))).encode(), "max_reference_tilt_deg"),
        ("track", Track(reference=Hold(attitude=(1.0, 0.0, 0.0))).encode(), "roll"),
        ("track", Track(reference=Hold(attitude=(0.0, 0.0, 90.0)), within_s=0.5).encode(), "max_reference_rate"),
        ("track", Track(reference=Sinusoid(frequency=(0.0, 3.0, 3.0))).encode(), "max_reference_rate"),
        ("track", Track(reference=LATER_TOO_FAST).encode(), "max_reference_rate"),
    ],
)
def test_what_is_refused_is_answered_with_the_reason_and_changes_nothing(
    loop: Loop, topic: str, payload: bytes, why: str
) -> None:
    alone = loop.fresh()
    asked = loop.ask(topic, payload)
    for k in range(10):
        assert loop.tick() == alone.tick(WIRE.measurement.pack(k, [0.0] * 6), k)
    (answer,) = asked.answers
    assert not answer.done
    assert why in answer.text
    assert len(answer.text.splitlines()) == 1
    assert len(loop.changes()) == 1  # what the session began with
    assert loop.events("changed") == []


@pytest.mark.parametrize(
    ("topic", "message"), [("set_gains", Gains(C1=(1.0, 1.0, 1.0))), ("track", Track(reference=LEVEL))]
)
def test_without_a_session_there_is_nothing_to_change(loop: Loop, topic: str, message: Message) -> None:
    loop.end()
    before = list(loop.network.put)
    asked = loop.ask(topic, message)
    loop.role.take_inbox()
    (answer,) = asked.answers
    assert not answer.done
    assert "controller-7 does not have aero" in answer.text
    assert loop.network.put == before
    loop.begin()
    assert loop.changes() == [
        Change(session="s1", tick=0, gains=Gains(C1=LAW.C1, C2=LAW.C2, Gamma=LAW.Gamma), reference=LEVEL)
    ]


# References

SWING = Sinusoid(amplitude=(0.0, 5.0, 20.0), frequency=(0.0, 0.5, 0.4))
THREE_POINTS = Points(times=[0.0, 1.0, 2.0], attitudes=[(0.0, 0.0, 1.0), (0.0, 5.0, 8.0), (0.0, 0.0, 9.0)])


@pytest.mark.parametrize(
    ("reference", "ends_at", "words"),
    [
        (Hold(attitude=(0.0, 0.0, 30.0)), (0.0, 0.0, 30.0), "turns to roll 0°, pitch 0°, yaw 30°"),
        (THREE_POINTS, (0.0, 0.0, 9.0), "follows 3 points over 2 s"),
    ],
)
def test_a_reference_holds_from_the_tick_that_is_published_and_arrives(
    loop: Loop, reference: Reference, ends_at: tuple[float, float, float], words: str
) -> None:
    loop.run(0.1)
    asked = loop.ask("track", Track(reference=reference, within_s=1.5))
    loop.tick()
    assert loop.changes()[1:] == [Change(session="s0", tick=50, reference=reference, within_s=1.5)]
    (answer,) = asked.answers
    assert answer.done
    assert words in answer.text
    assert [words in text for text in loop.events("changed")] == [True]
    loop.run(1.5 + 2.0)
    there = Controller(WIRE, LAW, Hold(attitude=ends_at), PERIOD)
    there.tick(WIRE.measurement.pack(0, [0.0] * 6), 0)
    assert loop.controller.desired == there.desired


def test_a_sinusoid_begins_where_it_is_reached(loop: Loop) -> None:
    loop.run(0.1)
    loop.ask("track", Track(reference=SWING, within_s=1.0))
    loop.run(1.0 + 0.5)
    reached = Controller(WIRE, LAW, SWING, PERIOD)
    k = loop.k - 1 - 550  # asked for at tick 50, reached 500 later
    reached.tick(WIRE.measurement.pack(0, [0.0] * 6), k)
    assert loop.controller.desired == pytest.approx(reached.desired, abs=1e-14)  # times of a few s, rounded


@pytest.mark.parametrize("reference", [Hold(attitude=None), Stream()])
def test_coming_to_rest_is_published_as_the_attitude_at_which_it_does(loop: Loop, reference: Reference) -> None:
    loop.ask("track", Track(reference=Sinusoid(amplitude=(0.0, 0.0, 20.0), frequency=(0.0, 0.0, 0.4)), within_s=0.5))
    loop.run(1.0)
    before = loop.yaw()
    asked = loop.ask("track", Track(reference=reference, within_s=0.02))  # brakes at once, whatever is given
    loop.run(1.1)
    assert asked.answers[0].done
    rest = loop.changes()[-1].reference
    assert isinstance(rest, Hold)
    assert rest.attitude is not None
    assert before + 0.4 < rest.attitude[2] < before + 1.0  # 0.75 v² / 1 rad/s² of 6.5 to 8°/s, and a little
    assert loop.yaw() == pytest.approx(rest.attitude[2], abs=1e-12)
    loop.end()
    loop.begin()
    assert loop.changes()[0].reference == rest  # and there the next session begins, not at 0


def test_going_back_in_the_middle_of_a_turn_brakes_first_and_never_swings_out(time: FakeTime) -> None:
    """Yaw 70°, turning by 12°/s, and 40 s to go to 30°: a single quintic would turn on to 115°."""
    del time
    loop = Loop(Sinusoid(amplitude=(0.0, 0.0, 100.0), frequency=(0.0, 0.0, 0.17)), CONFIGURED)
    loop.begin()
    loop.run(4.56)
    assert loop.yaw() == pytest.approx(70.0, abs=0.1)
    asked = loop.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 30.0)), within_s=40.0))
    loop.tick()
    assert asked.answers[0].text == "aero turns to roll 0°, pitch 0°, yaw 30° within 40 s"
    yaws = [loop.yaw()]
    for _ in range(round(40.0 / PERIOD)):
        loop.tick()
        yaws.append(loop.yaw())
    assert max(yaws) < 70.0 + 2.2  # 0.75 v² / 1 rad/s² is 1.9°, and it was still speeding up or slowing down
    assert min(yaws) == yaws[-1] == pytest.approx(30.0, abs=1e-9)
    loop.assert_it_runs_again()


@pytest.mark.parametrize("at_s", [2.0, 7.0, 12.0, 17.0, 22.0, 33.0])
def test_more_time_than_needed_is_never_too_much(time: FakeTime, at_s: float) -> None:
    """Going to 0 within 60 s in the middle of the default sinusoid; a single quintic would tilt upside down."""
    del time
    loop = Loop(Sinusoid(), CONFIGURED)
    loop.begin()
    loop.tick()
    loop.k = round(at_s / PERIOD)
    loop.tick()
    asked = loop.ask("track", Track(reference=LEVEL, within_s=60.0))
    loop.tick()
    assert asked.answers[0].done, asked.answers[0].text


def test_a_time_that_is_too_short_is_refused_and_the_one_that_is_named_accepted(loop: Loop) -> None:
    loop.ask("track", Track(reference=SWING, within_s=1.0))
    loop.run(2.0)
    refused = loop.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 60.0)), within_s=0.5))
    loop.tick()
    answer = refused.answers[0]
    assert not answer.done
    named = float(answer.text.split("; --in ")[1].removesuffix(" would do"))
    for within_s, done in ((0.9 * named, False), (1.02 * named, True)):  # it has moved on by two ticks meanwhile
        asked = loop.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 60.0)), within_s=within_s))
        loop.tick()
        assert asked.answers[0].done == done


# A stream


@pytest.fixture
def streaming(loop: Loop) -> Loop:
    """A loop that follows a stream, at rest and level, at tick 50."""
    loop.ask("track", Track(reference=Stream(timeout_s=0.5, within_s=0.2), within_s=0.05))
    loop.run(0.1)
    return loop


def test_set_points_are_followed(streaming: Loop) -> None:
    for yaw in (2.0, 3.0, -1.0):
        streaming.stream(yaw)
        streaming.run(0.204)
        assert streaming.yaw() == pytest.approx(yaw, abs=1e-12)
    changes = [(c.tick, c.reference, c.within_s) for c in streaming.changes()[2:]]
    assert changes == [(50 + 102 * i, Hold(attitude=(0.0, 0.0, yaw)), 0.2) for i, yaw in enumerate((2.0, 3.0, -1.0))]


def test_of_set_points_between_two_ticks_the_newest_counts(streaming: Loop) -> None:
    before = len(streaming.changes())
    for yaw in (9.0, 5.0, 2.0):
        streaming.stream(yaw)
    streaming.run(0.3)
    assert [change.reference for change in streaming.changes()[before:]] == [Hold(attitude=(0.0, 0.0, 2.0))]
    assert streaming.yaw() == pytest.approx(2.0, abs=1e-12)


def test_a_newer_set_point_is_taken_up_on_the_way_to_the_last(streaming: Loop) -> None:
    for yaw in (1.0, 2.0, 3.0, 4.0):
        streaming.stream(yaw)
        streaming.run(0.02)
    streaming.run(0.2)
    assert streaming.yaw() == pytest.approx(4.0, abs=1e-12)


def test_a_set_point_that_is_too_far_takes_longer_and_is_never_faster_than_the_limit(streaming: Loop) -> None:
    streaming.stream(yaw=90.0)
    fastest, before = 0.0, streaming.yaw()
    while streaming.yaw() < 89.999:
        streaming.tick()
        fastest = max(fastest, radians(streaming.yaw() - before) / PERIOD)
        before = streaming.yaw()
        assert streaming.k < 3000
    # 15/8 of 90° at 1 rad/s are 2.95 s; it takes 5 % more than that.
    assert streaming.changes()[-1].within_s == pytest.approx(1.05 * 15 / 8 * radians(90), rel=1e-9)
    assert 0.9 < fastest <= 1.0


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"yaw 10",
        b'{"attitude": [0, 0]}',
        b'{"attitude": [0, 0, NaN]}',
        b'{"attitude": [0, 0, 0], "speed": 1}',
        Setpoint(attitude=(0.0, 61.0, 0.0)).encode(),
        Setpoint(attitude=(5.0, 0.0, 0.0)).encode(),
    ],
)
def test_a_set_point_that_is_refused_is_counted_and_changes_nothing(streaming: Loop, payload: bytes) -> None:
    before = streaming.changes()
    streaming.stream(3.0)
    streaming.raw(payload)
    streaming.run(0.3)
    assert streaming.live.refused == 1
    assert [len(text.splitlines()) for text in streaming.events("fault")] == [1]
    assert len(streaming.changes()) == len(before) + 1  # the good one that came before it
    assert streaming.yaw() == pytest.approx(3.0, abs=1e-12)


def test_refused_set_points_are_reported_at_most_once_in_ten_seconds(streaming: Loop, time: FakeTime) -> None:
    start = time.now
    while time.now < start + 25.0:
        streaming.raw(b"junk")
        time.now += 0.25
    assert streaming.live.refused == 100
    assert len(streaming.events("fault")) == 3  # at 0 s, 10 s and 20 s
    assert "39 more like it" in streaming.events("fault")[1]


def test_silence_is_reported_once_and_the_last_set_point_held_until_there_is_another(
    streaming: Loop, time: FakeTime
) -> None:
    streaming.stream(2.0)
    streaming.run(0.3)
    time.now += 0.499
    streaming.tick()
    assert streaming.events("lost") == []
    time.now += 0.002
    streaming.run(0.1)
    time.now += 100.0
    streaming.run(0.1)
    assert streaming.events("lost") == ["no set-point for 0.5 s: holds the last one"]
    assert streaming.yaw() == pytest.approx(2.0, abs=1e-12)
    streaming.stream(-2.0)
    streaming.run(0.3)
    assert streaming.yaw() == pytest.approx(-2.0, abs=1e-12)
    assert len(streaming.events("lost")) == 1
    time.now += 0.6
    streaming.tick()
    assert len(streaming.events("lost")) == 2


def test_a_stream_that_never_begins_is_silent_too(streaming: Loop, time: FakeTime) -> None:
    time.now += 0.6
    streaming.tick()
    assert len(streaming.events("lost")) == 1


def test_set_points_without_a_stream_reference_are_ignored(loop: Loop, time: FakeTime) -> None:
    loop.stream(5.0)
    loop.raw(b"junk")
    time.now += 5.0
    loop.run(0.3)
    assert (loop.live.refused, loop.yaw(), len(loop.changes())) == (0, 0.0, 1)
    assert loop.events("lost") == loop.events("fault") == []


def test_a_stream_is_over_once_something_else_is_tracked(streaming: Loop, time: FakeTime) -> None:
    streaming.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 4.0)), within_s=0.2))
    streaming.tick()
    streaming.stream(-3.0)
    time.now += 5.0
    streaming.run(0.3)
    assert streaming.yaw() == pytest.approx(4.0, abs=1e-12)
    assert streaming.events("lost") == []


def test_a_new_stream_is_at_rest_until_its_own_first_set_point(streaming: Loop) -> None:
    streaming.stream(9.0)
    streaming.ask("track", Track(reference=LEVEL, within_s=0.2))  # both between the same two ticks
    streaming.run(0.3)
    streaming.ask("track", Track(reference=Stream(), within_s=0.2))
    streaming.run(0.5)
    assert streaming.yaw() == pytest.approx(0.0, abs=1e-12)


def test_the_way_to_a_set_point_never_tilts_too_far(streaming: Loop) -> None:
    streaming.stream(pitch=59.0)
    streaming.run(1.25)
    streaming.stream(pitch=-59.0)
    steepest = 0.0
    for _ in range(2500):
        streaming.tick()
        w, x, y, z = streaming.controller.desired
        assert (x, z) == (0.0, 0.0)
        steepest = max(steepest, degrees(2 * atan2(abs(y), w)))
    assert steepest <= 60.0


# The next session, and a configuration that is read again


def turned(yaw: float) -> list[float]:
    """The codes of a body at rest that has yawed [deg]."""
    attitude, rate = WIRE.attitude.quantizer(), WIRE.rate.quantizer()
    return [*(attitude.encode(x) for x in (0.0, 0.0, sin(radians(yaw) / 2))), *(rate.encode(0.0) for _ in range(3))]


def test_a_session_that_begins_far_from_its_reference_goes_there_from_where_the_body_is(loop: Loop) -> None:
    loop.ask("track", Track(reference=LEVEL, within_s=0.2))
    loop.run(0.5)
    loop.end()
    loop.begin()
    loop.tick(turned(90.0))
    (first, way) = loop.changes()
    assert (first.tick, way.tick, way.reference) == (0, 0, LEVEL)
    assert way.start == pytest.approx((0.0, 0.0, 90.0), abs=1.0)  # a level of ε is 0.9° wide here
    # From rest to rest a quintic is at most 15/8 of its mean speed.
    assert way.within_s == pytest.approx(radians(90) * 15 / 8 / 1.0, rel=0.1)
    assert loop.yaw() == pytest.approx(90.0, abs=1.0)
    for _ in range(round(way.within_s / PERIOD) + 2):
        loop.tick(turned(90.0))
    assert loop.yaw() == pytest.approx(0.0, abs=1e-9)
    assert len(loop.changes()) == 2


def test_a_session_goes_to_its_reference_by_less_than_a_turn(loop: Loop) -> None:
    """A body at −60° is at 300°, too; to 350° it goes from there, not the 410° from −60°."""
    loop.ask("track", Track(reference=Hold(attitude=(0.0, 0.0, 350.0)), within_s=20.0))
    loop.tick()
    loop.end()
    loop.begin()
    loop.tick(turned(-60.0))
    way = loop.changes()[-1]
    assert way.start == pytest.approx((0.0, 0.0, 300.0), abs=1.0)
    assert way.within_s == 20.0  # no faster than the operator wanted


def test_a_session_that_begins_near_its_reference_follows_it_at_once(loop: Loop) -> None:
    loop.end()
    loop.begin()
    loop.tick(turned(15.0))
    assert [change.tick for change in loop.changes()] == [0]


def test_the_next_session_begins_with_the_gains_and_the_reference_of_now(loop: Loop) -> None:
    loop.ask("set_gains", Gains(C2=(0.4, 0.4, 0.4)))
    loop.ask("track", Track(reference=SWING, within_s=0.5))
    loop.run(1.0)
    loop.end()
    loop.begin()
    gains = Gains(C1=LAW.C1, C2=(0.4, 0.4, 0.4), Gamma=LAW.Gamma)
    assert loop.changes() == [Change(session="s1", tick=0, gains=gains, reference=SWING)]
    expected = Controller(WIRE, LawSettings(C2=(0.4, 0.4, 0.4)), SWING, PERIOD)
    for k in range(100):
        assert loop.tick() == expected.tick(WIRE.measurement.pack(k % WIRE.measurement.counters, [0.0] * 6), k)


def test_the_next_session_waits_where_the_stream_has_left_it_and_goes_on_with_it(streaming: Loop) -> None:
    streaming.stream(3.0)
    streaming.run(0.1)
    streaming.end()
    streaming.begin()
    assert [change.reference for change in streaming.changes()] == [Hold(attitude=(0.0, 0.0, 3.0))]
    streaming.run(0.1)
    assert streaming.yaw() == pytest.approx(3.0, abs=1e-12)
    streaming.stream(1.0)
    streaming.run(0.3)
    assert streaming.yaw() == pytest.approx(1.0, abs=1e-12)


def test_a_configuration_read_again_takes_over_what_differs_and_leaves_an_operators_word(loop: Loop) -> None:
    loop.ask("track", Track(reference=SWING, within_s=0.5))
    loop.run(0.1)
    gains = {"C1": (0.5, 0.5, 0.5)}
    loop.role.enqueue(lambda: loop.live.adopt(LawSettings.model_validate(gains), LEVEL))  # LEVEL is configured
    loop.run(0.1)
    assert loop.controller.gains == Gains(C1=(0.5, 0.5, 0.5), C2=LAW.C2, Gamma=LAW.Gamma)
    assert [(change.tick, change.reference) for change in loop.changes()[1:]] == [(0, SWING), (50, None)]
    loop.ask("set_gains", Gains(C1=(0.6, 0.6, 0.6)))
    loop.tick()
    turned = Hold(attitude=(0.0, 0.0, 5.0))
    loop.role.enqueue(lambda: loop.live.adopt(LawSettings.model_validate(gains), turned))
    loop.run(2.5)
    assert loop.controller.gains == Gains(C1=(0.6, 0.6, 0.6), C2=LAW.C2, Gamma=LAW.Gamma)
    assert loop.changes()[-1].reference == turned
    assert loop.yaw() == pytest.approx(5.0, abs=1e-12)


def test_limits_that_are_read_again_hold_for_what_is_asked_next(loop: Loop) -> None:
    loop.live.configure(ControllerSettings(max_reference_tilt_deg=10.0))
    asked = loop.ask("track", Track(reference=Hold(attitude=(0.0, 11.0, 0.0))))
    loop.tick()
    assert not asked.answers[0].done
    assert "max_reference_tilt_deg = 10" in asked.answers[0].text


def test_a_configured_reference_that_is_far_away_is_reached_as_soon_as_the_limits_allow(loop: Loop) -> None:
    loop.role.enqueue(lambda: loop.live.adopt(LAW, Hold(attitude=(0.0, 0.0, 170.0))))
    loop.tick()
    assert loop.events("fault") == []
    assert loop.changes()[-1].within_s == pytest.approx(radians(170) * 15 / 8, rel=1e-9)


def test_a_configured_reference_beyond_the_limits_is_reported_and_ends_nothing(loop: Loop) -> None:
    loop.role.enqueue(lambda: loop.live.adopt(LAW, Hold(attitude=(0.0, 70.0, 0.0))))  # as reload.py's SIGHUP does
    loop.tick()


far = st.tuples(st.just(0.0), st.integers(-65, 65).map(float), st.integers(-180, 180).map(float))


@settings(max_examples=25)
@given(
    sent=st.lists(st.tuples(far, st.integers(1, 400)), min_size=2, max_size=10),
    within_s=st.sampled_from([0.02, 0.2, 1.0]),
)
def test_whatever_streams_however_quickly_the_limits_hold(
    sent: list[tuple[tuple[float, float, float], int]], within_s: float
) -> None:
    """Set-points anywhere, some of them too tilted, up to 0.8 s from each other, most in the middle of the last."""
    loop = Loop(Stream(within_s=within_s), CONFIGURED)
    loop.begin()
    for attitude, ticks in [*sent, ((0.0, 0.0, 0.0), 1500)]:
        loop.raw(Setpoint(attitude=attitude).encode())
        for _ in range(ticks):
            loop.tick()
            # The body is level and at rest, so its rate's error is ω_d. Ways are sampled, which may miss 0.4 % of a
            # rate (../control/test_motion.py), and of a tilt, at such a rate, less than a hundredth of a degree.
            assert hypot(*loop.controller.rate_error) <= 1.0 * 1.004
            _, x, y, _ = loop.controller.desired
            assert degrees(acos(1 - 2 * (x * x + y * y))) <= 60.01
    for change in loop.changes()[1:]:
        assert change.within_s <= 60.0  # and it gets there
    loop.assert_it_runs_again()


# The log

angle = st.integers(-20, 20).map(float)
attitudes = st.tuples(st.just(0.0), angle, angle)
gain = st.tuples(*[st.integers(1, 2000).map(lambda n: n / 1000)] * 3)
gains = st.builds(Gains, C1=gain | st.none(), C2=gain | st.none(), Gamma=gain | st.none())
within = st.integers(100, 3000).map(lambda n: n / 1000)
swings = st.builds(
    Sinusoid,
    amplitude=attitudes,
    frequency=st.tuples(st.just(0.0), *[st.integers(0, 10).map(lambda n: n / 10)] * 2),
)
points = st.lists(st.tuples(st.integers(200, 2000), attitudes), min_size=2, max_size=4).map(
    lambda rows: Points(
        times=[ms / 1000 for ms in accumulate((gap for gap, _ in rows[1:]), initial=0)],
        attitudes=[attitude for _, attitude in rows],
    )
)
anything = st.one_of(
    st.builds(Hold, attitude=attitudes | st.none()), swings, points, st.builds(Stream, within_s=st.just(0.2))
)
measured = st.lists(st.integers(-100, 100).map(lambda n: n / 250), min_size=6, max_size=6)
steps: st.SearchStrategy[tuple[str, Any]] = st.one_of(
    st.tuples(st.just("ticks"), st.lists(measured, min_size=1, max_size=60)),
    st.tuples(st.just("ticks"), st.lists(measured, min_size=1, max_size=60)),
    st.tuples(st.just("set_gains"), gains),
    st.tuples(st.just("track"), st.builds(Track, reference=anything, within_s=within)),
    st.tuples(st.just("set-points"), st.lists(attitudes, min_size=1, max_size=3)),
    st.tuples(st.just("time"), st.sampled_from([0.1, 1.0])),
    st.tuples(st.sampled_from(["no valid value", "malformed", "gap", "next session", "read again"]), st.none()),
)


@settings(max_examples=40)
@given(
    configured=st.one_of(st.just(Sinusoid()), st.just(LEVEL), st.just(Stream())),
    after_restart=st.sampled_from(["hold", "resume", "configured"]),
    history=st.lists(steps, min_size=4, max_size=25),
)
def test_from_the_logged_changes_a_fresh_controller_gives_the_same_commands_byte_for_byte(
    configured: Reference, after_restart: str, history: list[tuple[str, Any]]
) -> None:
    fake = FakeTime()
    with pytest.MonkeyPatch.context() as patch:
        for module in (throttle, role, live):
            patch.setattr(module, "time", fake)
        given = {"max_reference_rate": 50.0, "after_restart": after_restart}
        loop = Loop(configured, ControllerSettings.model_validate(given))
        loop.begin()
        for what, value in [*history, ("ticks", [[0.1, 0.0, 0.2, 0.0, 0.1, 0.3]] * 30)]:
            match what:
                case "ticks":
                    for codes in value:
                        loop.tick(codes)
                case "set_gains" | "track":
                    loop.ask(what, value)
                case "set-points":
                    for attitude in value:
                        loop.raw(Setpoint(attitude=attitude).encode())
                case "time":
                    fake.now += value
                case "no valid value":
                    loop.tick(NO_VALID_VALUE)
                case "malformed":
                    loop.malformed()
                case "gap":
                    loop.k += 40
                case "next session":
                    loop.end()
                    loop.begin()
                case "read again":
                    loop.role.enqueue(lambda: loop.live.adopt(LawSettings(C1=(0.7, 0.7, 0.7)), SWING))
        loop.assert_it_runs_again()
