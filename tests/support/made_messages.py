"""Synthetic messages of both ends in a session: traces, telemetry, truth and statuses."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import NamedTuple

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import ControllerRow, Outcome, PlantRow, Sent, TraceWriter
from aeroloop.protocol.messages.trace import Received as ReceivedAs
from aeroloop.service.config import Settings

VEHICLE, SESSION = "aero", "s1"
TELEMETRY_EVERY, TRUTH_EVERY, STATUS_EVERY = 20, 10, 500
"""Ticks; at 500 Hz telemetry comes at 25 Hz, truth at 50 Hz and statuses at 1 Hz."""


class Published(NamedTuple):
    """A message before it is published."""

    topic: str
    role: str
    payload: bytes

    @property
    def key(self) -> str:
        return topics.key(self.topic, VEHICLE, role=self.role)


def description_of(settings: Settings, role: str, vehicle: str = VEHICLE) -> Description:
    return Description(
        protocol=PROTOCOL_VERSION, role=role, vehicle=vehicle, host="h", versions={}, config=settings.description()
    )


class Ends:
    """Both ends of one session.

    Args:
        settings: Of both.
        rows: Rows of a batch.
        changes: What an operator changes, by tick.
    """

    def __init__(self, settings: Settings, rows: int = 50, changes: dict[int, Change] | None = None) -> None:
        self._wire = settings.wire
        self._rows = rows
        self._changes = changes or {}
        self._random = random.Random(7)
        self._plant = TraceWriter("plant", settings.wire, 11)
        self._controller = TraceWriter("controller", settings.wire, 12)
        self._plant.session = self._controller.session = SESSION

    def tick(self, k: int, now_ns: int, wall_ns: int) -> Iterator[Published]:
        """What tick k publishes, now on the monotonic and on the wall clock [ns]."""
        measurement = self._wire.measurement.pack(k & 15, [self._random.randrange(-20, 20) for _ in range(6)])
        command = self._wire.command.pack(k & 15, [self._random.randrange(-5, 5) for _ in range(self._wire.actuators)])
        self._plant.row(PlantRow(
            k, k, Sent.FRAME, Sent.FRAME, Outcome.ACTED, 0, k - 1, now_ns, now_ns - 1_000_000, measurement, command,
            [self._random.uniform(-18, 18) for _ in range(self._wire.actuators)],
        ))  # fmt: skip
        if k in self._changes:
            self._controller.changes.append(self._changes[k])
        self._controller.row(
            ControllerRow(k, ReceivedAs.FRAME, Sent.FRAME, now_ns + 200_000, now_ns + 300_000, measurement, command)
        )
        if k % self._rows == self._rows - 1:
            yield Published("trace", "plant", self._plant.take(now_ns, wall_ns))
            yield Published("trace", "controller", self._controller.take(now_ns, wall_ns))
        if k % TELEMETRY_EVERY == 0:
            yield Published("telemetry", "controller", self._telemetry(k).encode())
        if k % TRUTH_EVERY == 0:
            yield Published("truth", "plant", self._truth(k).encode())
        if k % STATUS_EVERY == 0:
            for role in ("plant", "controller"):
                status = Status(role=role, state="driven", uptime_s=k / 500, ticks=k, rate_hz=500.0, skipped=0)
                yield Published("status", role, status.encode())

    def _telemetry(self, k: int) -> Telemetry:
        x, y, z, p, q, r = (self._random.uniform(-0.05, 0.05) for _ in range(6))
        return Telemetry(
            session=SESSION,
            tick=k,
            counter=k & 15,
            attitude_error=(x, y, z),
            rate_error=(p, q, r),
            desired=(0.99123456789, 0.0123456789, 0.0456789123, 0.0789123456),
            state={"damping_estimate": (0.00123456789, 0.00456789123, 0.00789123456), "sign": (1.0,)},
            voltages=(100 * x, 100 * y),
        )

    def _truth(self, k: int) -> Truth:
        x, y, z, p, q, r = (self._random.uniform(-0.05, 0.05) for _ in range(6))
        return Truth(tick=k, attitude=(0.995, x, y, z), rate=(p, q, r), voltages=(100 * x, 100 * y))
