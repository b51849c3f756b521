"""A loop that sends only what is new, in simulated time: frames late, lost or malformed, ticks missed on either side.

Plant and controller are the project's own parts for it (Sender, Hearing); the network, the clock and what is measured
are made up. What comes out is what a recorder would have, and what the controller really used at each tick.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import pytest

from protocol.clock import LoopSettings
from protocol.frames import DEFAULT_COUNTER_BITS
from protocol.links import Arrival, Link
from protocol.messages import Lapse, Telemetry
from protocol.transmit import SILENCE, Policy, Sender, Transmit
from protocol.wire import WireSpec
from service import hearing

COUNTERS = 1 << DEFAULT_COUNTER_BITS

PERIOD_NS = 2_000_000
START_NS = 1_800_000_000_000_000_000
LOOP = LoopSettings(rate_hz=500)

Codes = tuple[int, ...]


def wire_of(measurement: Policy, command: Policy) -> WireSpec:
    return WireSpec(transmit=Transmit(measurement=measurement, command=command))


class Wire(Link):
    """The controller's end of a simulated link, which is also its clock."""

    def __init__(self, arrivals: list[Arrival], depth: int) -> None:
        self.now_ns = 0
        self._coming = deque(arrivals)
        self._waiting: deque[Arrival] = deque(maxlen=depth)

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.pass_time(self.now_ns + round(seconds * 1e9))

    def pass_time(self, until_ns: int) -> None:
        self.now_ns = max(self.now_ns, until_ns)
        while self._coming and self._coming[0].at_ns <= self.now_ns:
            self._waiting.append(self._coming.popleft())

    @property
    def over(self) -> bool:
        return not self._coming and not self._waiting

    @property
    def pending(self) -> bool:
        self.pass_time(self.now_ns)
        return bool(self._waiting)

    def take(self) -> Arrival | None:
        return self._waiting.popleft() if self.pending else None

    def wait(self, timeout_s: float) -> Arrival | None:
        if not self.pending:
            deadline = self.now_ns + round(timeout_s * 1e9)
            self.pass_time(min(deadline, self._coming[0].at_ns) if self._coming else deadline)
        return self.take()

    def send(self, frame: bytes) -> None:
        raise AssertionError(f"commands go into the log, not out: {frame.hex()}")

    def close(self) -> None:
        pass


@dataclass
class Logged:
    """What came of it.

    Attributes:
        messages: Topic, content and time of publication, as a recorder has them.
        lapses: What the controller told.
        used: Codes that it used at each tick that it computed.
        commanded: And what it commanded then.
        last: The last tick of which a log can know: the last that a command frame answers.
    """

    messages: list[tuple[Literal["measurement", "command", "telemetry"], bytes, int]] = field(default_factory=list)
    lapses: list[Lapse] = field(default_factory=list)
    used: dict[int, Codes] = field(default_factory=dict)
    commanded: dict[int, Codes] = field(default_factory=dict)
    last: int = -1


def run(seed: int, wire: WireSpec, monkeypatch: pytest.MonkeyPatch, *, own_grid: bool = False) -> Logged:
    """A session of 400 ticks; which are late, missed and malformed, the seed says."""
    chance = random.Random(seed)
    hitch = chance.choice([0.0, 0.01, 0.1])  # how often anything takes longer than it should
    # In ticks. Where each measurement is answered however late it is, three of the worst must stay below 12 ticks, for
    # four bits of a command's echo tell no more.
    worst = chance.choice([3, 9]) if wire.transmit.measurement == "on_change" else 3

    def takes(usual_ns: int) -> int:
        longer = chance.random() < hitch
        return round(chance.uniform(0.5, 1.0) * usual_ns + (chance.uniform(0, worst) * PERIOD_NS if longer else 0))

    logged = Logged()
    arrivals = _plant(wire, 400, takes, chance, logged)
    link = Wire(arrivals, hearing.MAILBOX if wire.transmit.measurement == "on_change" else 1)
    monkeypatch.setattr(hearing, "time", link)
    if own_grid:
        link.now_ns = chance.randrange(PERIOD_NS)
        monkeypatch.setattr("protocol.clock.time", link)
    heard_by = hearing.Hearing(link, LOOP, wire, own_grid=own_grid)
    sender = Sender(wire.transmit.command, wire.transmit.heartbeat_ticks(PERIOD_NS, COUNTERS), COUNTERS)
    k = -1
    held: Codes = ()
    said: Codes = (0, 0)
    while not link.over:
        heard = heard_by.next(0.02)
        if heard is None:
            continue
        read = wire.measurement.unpack(heard.frame)
        held = read[1] if read else held  # type: ignore[assignment]  # codes of a quantized wire are whole
        used = read is not None or (heard.frame == SILENCE and not heard.late)
        lapses = heard_by.lapses(heard, k, used=used)
        logged.lapses += [Lapse(session="s", kind=kind, tick=tick, ticks=ticks) for kind, tick, ticks in lapses]
        if heard.late:
            continue
        k = heard.tick
        if not used:
            continue
        link.pass_time(link.now_ns + takes(200_000))
        said = (said[0] + chance.choice([0, 0, 0, 1, -1]), said[1])
        said = (max(-31, min(31, said[0])), said[1])
        logged.used[k], logged.commanded[k] = held, said
        at_ns = START_NS + link.now_ns
        if sender.due(k, said):
            logged.messages.append(("command", wire.command.pack(k % COUNTERS, said), at_ns))
            logged.last = k
        if k % 10 == 0:
            logged.messages.append(("telemetry", _telemetry(k).encode(), at_ns + 1000))
    logged.messages.sort(key=lambda message: message[2])
    return logged


def _plant(wire: WireSpec, ticks: int, takes, chance: random.Random, logged: Logged) -> list[Arrival]:  # type: ignore[no-untyped-def]
    sender = Sender(wire.transmit.measurement, wire.transmit.heartbeat_ticks(PERIOD_NS, COUNTERS), COUNTERS)
    garbled, lost = chance.choice([0.0, 0.05]), chance.choice([0.0, 0.05])  # lost on the way to the controller only
    number = 0
    codes: Codes = (0,) * 6
    arrivals: list[Arrival] = []
    k = done_ns = arrived_ns = 0
    while k < ticks:
        published_ns = max(done_ns, k * PERIOD_NS) + (takes(50_000) if k else 0)
        if chance.random() < 0.3:
            codes = (*codes[:5], max(-127, min(127, codes[5] + chance.choice([-1, 1]))))
        if sender.due(k, codes):
            frame = wire.measurement.pack(k % COUNTERS, codes)
            if k and chance.random() < garbled:
                frame = frame[:-1] + b"\1"  # as it reaches the recorder, too: its padding is not zero
            arrived_ns = max(arrived_ns + 1000, published_ns + takes(150_000))
            if chance.random() >= lost:
                arrivals.append(Arrival(frame, arrived_ns, START_NS + published_ns, number))
            number += 1
            logged.messages.append(("measurement", frame, START_NS + published_ns))
        done_ns = published_ns
        k = max(k + 1, -(-done_ns // PERIOD_NS))  # the grid goes on; what was missed is skipped
    return arrivals


def _telemetry(k: int) -> Telemetry:
    return Telemetry(
        session="s", tick=k, counter=k % COUNTERS, attitude_error=(0, 0, 0), rate_error=(0, 0, 0), desired=(1, 0, 0, 0),
        damping_estimate=(0, 0, 0), voltages=(0.0, 0.0), sign=1,
    )  # fmt: skip
