"""Live view of the network: every role of every vehicle, from its published messages.

Subscribes to status, telemetry, truth and events, and queries descriptions, which hold the wire. Publishes nothing.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import degrees
from typing import Final

import zenoh
from pydantic import ValidationError
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Status, Telemetry, Truth
from aeroloop.protocol.transport.network import NetworkSettings, join
from aeroloop.protocol.wire.attitude import angle, to_euler
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.host.bandwidth import PayloadRate
from aeroloop.service.terminal.display import p50_p99

REFRESH_S: Final = 0.2
SILENT_S: Final = 3.0
"""A role without a status for this long, three of its periods, is shown as silent [s]."""
EVENTS: Final = 5


@dataclass
class Vehicle:
    """The latest messages of one vehicle."""

    statuses: dict[str, tuple[float, Status]] = field(default_factory=dict)
    telemetry: Telemetry | None = None
    truth: Truth | None = None
    settings: Settings | None = None
    payload: PayloadRate = field(default_factory=PayloadRate)


class Top:
    """Collects messages and draws them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._vehicles: dict[str, Vehicle] = {}
        self._events: deque[str] = deque(maxlen=EVENTS)

    def receive(self, key: str, payload: bytes) -> None:
        """Take in a message of any topic; drops what it cannot parse."""
        address = topics.read_key(key)
        if address is None:
            return
        with self._lock:
            vehicle = self._vehicles.setdefault(address.vehicle, Vehicle())
            try:
                match address.topic.name:
                    case "status" if address.role is not None:
                        status = Status.model_validate_json(payload)
                        vehicle.statuses[address.role] = time.monotonic(), status
                        if address.role == "controller":
                            vehicle.payload.receive(status)
                    case "telemetry":
                        vehicle.telemetry = Telemetry.model_validate_json(payload)
                    case "truth":
                        vehicle.truth = Truth.model_validate_json(payload)
                    case "description" if address.role in ("plant", "controller"):
                        vehicle.settings = from_description(Description.model_validate_json(payload).config)
                    case "event":
                        event = Event.model_validate_json(payload)
                        self._events.append(f"{time.strftime('%H:%M:%S')} {address.vehicle} {event.role}: {event.text}")
            except (ValidationError, ConfigError):
                pass  # of another version; its other messages may still parse

    def draw(self) -> RenderableType:
        """The current view."""
        with self._lock:
            if not self._vehicles:
                return Text("no role on the network yet")
            blocks: list[RenderableType] = []
            for name, vehicle in sorted(self._vehicles.items()):
                blocks += [Text(name, style="bold"), _flight(vehicle), _roles(vehicle), Text("")]
            return Group(*blocks, *(Text(event, overflow="ellipsis", no_wrap=True) for event in self._events))


def _flight(vehicle: Vehicle) -> Text:
    parts = []
    if vehicle.truth is not None:
        roll, pitch, yaw = (degrees(part) for part in to_euler(vehicle.truth.attitude))
        parts.append(f"roll {roll:+6.1f}°  pitch {pitch:+6.1f}°  yaw {yaw:+7.1f}°")
    if vehicle.telemetry is not None:
        parts.append(f"error {degrees(angle(*vehicle.telemetry.attitude_error)):5.2f}°")
        parts.append("volts " + " ".join(f"{u:+6.1f}" for u in vehicle.telemetry.voltages))
    if vehicle.settings is not None and "controller" in vehicle.statuses:
        measured, commanded = vehicle.payload.bits_per_s(vehicle.settings.wire)
        parts.append(f"{measured / 1000:.1f} + {commanded / 1000:.1f} kbit/s")
    return Text("   ".join(parts) or "no telemetry")


def _roles(vehicle: Vehicle) -> Table:
    table = Table(
        "role", "state", "rate", "skipped", "latency", "answers in", "wake-up", "received", "", box=None, pad_edge=False
    )
    for role, (received, status) in sorted(vehicle.statuses.items()):
        age, wake = time.monotonic() - received, status.timing.recent_wake if status.timing else None
        table.add_row(
            role,
            status.state if age < SILENT_S else "silent",
            f"{status.rate_hz:.0f}/s",
            str(status.skipped),
            *(p50_p99(spread) for spread in (status.latency_us, status.age_us, wake)),
            f"{age:.1f} s ago",
            status.cause or "",
            style="" if age < SILENT_S else "dim",
        )
    return table


def watch(network: NetworkSettings, show: Callable[[RenderableType], None], stop: threading.Event) -> None:
    """Subscribe, and draw five times a second until `stop` is set.

    Raises:
        NetworkError: The network cannot be joined.
    """
    top = Top()

    def receive(sample: zenoh.Sample) -> None:
        top.receive(str(sample.key_expr), sample.payload.to_bytes())

    with join(network, listen=False) as session:
        for name in ("status", "telemetry", "truth", "event"):
            session.declare_subscriber(topics.key(name, "*"), receive)
        queried = 0.0
        while not stop.wait(REFRESH_S):
            if time.monotonic() - queried > 2.0:  # for roles that have joined since
                queried = time.monotonic()
                for reply in session.get(topics.key("description", "*"), timeout=1.0):
                    if reply.ok is not None:
                        top.receive(str(reply.ok.key_expr), reply.ok.payload.to_bytes())
            show(top.draw())
