"""Simulated link, one end, which is also its receiver's clock: time passes only on request."""

from __future__ import annotations

from collections import deque

from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import Policy, Transmit
from tests.support.clock import FakeClock

PERIOD_NS = 2_000_000
LOOP = LoopSettings(rate_hz=500)


def wire_of(measurement: Policy, command: Policy) -> WireSpec:
    return WireSpec(transmit=Transmit(measurement=measurement, command=command))


class SimulatedLink(FakeClock, Link):
    def __init__(self, arrivals: list[Arrival], depth: int) -> None:
        super().__init__(now_ns=0)
        self._coming = deque(arrivals)
        self._waiting: deque[Arrival] = deque(maxlen=depth)
        self.sent: list[tuple[int, bytes]] = []

    def sleep(self, seconds: float) -> None:
        self.pass_time(self.now_ns + round(seconds * 1e9))

    def pass_time(self, until_ns: int) -> None:
        self.now_ns = max(self.now_ns, until_ns)
        while self._coming and self._coming[0].at_ns <= self.now_ns:
            self._waiting.append(self._coming.popleft())

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
        self.sent.append((self.now_ns, frame))

    def close(self) -> None:
        pass
