"""Fixtures of recording tests: a session, a clock and a disk."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Change, Gains, Hold
from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.config import load
from aeroloop.service.recording import rolling
from tests.support.made_messages import SESSION, VEHICLE, Ends, description_of
from tests.support.made_recording import Arrived, Clock, Disk, EventLog

TICKS = 600
START_NS = 1_800_000_000_000_000_000
CHANGES = {
    0: Change(session=SESSION, tick=0, gains=Gains(), reference=load().reference),
    120: Change(session=SESSION, tick=120, gains=Gains(C2=(0.2, 0.2, 0.2))),
    250: Change(session=SESSION, tick=250, reference=Hold(attitude=(0.0, 5.0, -10.0)), within_s=1.0),
    400: Change(session=SESSION, tick=400, gains=Gains(Gamma=(0.01, 0.01, 0.01))),
}


@pytest.fixture(scope="session")
def story() -> EventLog:
    """A session of 1.2 s in batches of one row, in which an operator changes something at 0.24, 0.5 and 0.8 s."""
    settings = load()
    ends = Ends(settings, rows=1, changes=CHANGES)
    messages: list[Arrived] = []
    numbers: Counter[str] = Counter()
    for k in range(TICKS):
        at_ns = START_NS + k * 2_000_000
        for said in ends.tick(k, k * 2_000_000 + 1, at_ns):
            # received some time after it was published, so that the two cannot be taken for each other
            received = Delivery(said.key, said.payload, 5 + numbers[said.key], at_ns, None)
            messages.append(Arrived(received, at_ns + 77))
            numbers[said.key] += 1
    description = description_of(settings, "plant").encode()
    return EventLog(topics.key("description", VEHICLE, role="plant"), description, messages, list(CHANGES.values()))


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    disk.install(monkeypatch)
    return disk


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, disk: Disk) -> Clock:
    """With a disk that is not a real one."""
    del disk
    clock = Clock()
    monkeypatch.setattr(rolling, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock
