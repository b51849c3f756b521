"""Live view of the network: every role of every vehicle, from its published messages.

Subscribes to status, telemetry, truth and events, and queries descriptions, which hold the wire. What is shown is true
now: values of a session that has ended are left out, and what was not received for `SILENT_S` is marked with its age.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import degrees, inf
from typing import Final

import zenoh
from pydantic import ValidationError
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.text import Text

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Status, Telemetry, Truth
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import angle, to_euler
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.host.bandwidth import PayloadRate
from aeroloop.service.host.health import SILENT_S
from aeroloop.service.terminal.roles import STALE, WAITING, duration, roles_view

REFRESH_S: Final = 0.2
EVENTS: Final = 5


@dataclass
class Vehicle:
    """The latest messages of one vehicle, with the time of their arrival on `time.monotonic()`."""

    statuses: dict[str, tuple[float, Status]] = field(default_factory=dict)
    telemetry: tuple[float, Telemetry] | None = None
    truth: tuple[float, Truth] | None = None
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
                        vehicle.telemetry = time.monotonic(), Telemetry.model_validate_json(payload)
                    case "truth":
                        vehicle.truth = time.monotonic(), Truth.model_validate_json(payload)
                    case "description" if address.role in ("plant", "controller"):
                        vehicle.settings = from_description(Description.model_validate_json(payload).config)
                    case "event":
                        event = Event.model_validate_json(payload)
                        self._events.append(
                            f"{time.strftime('%H:%M:%S')} {address.vehicle} {address.role}: {event.text}"
                        )
            except (ValidationError, ConfigError):
                pass  # of another version; its other messages may still parse

    def draw(self, width: int) -> RenderableType:
        """The current view, for a terminal of this width."""
        with self._lock:
            if not self._vehicles:
                return Text("no role on the network yet")
            now, blocks = time.monotonic(), list[RenderableType]()
            for name, vehicle in sorted(self._vehicles.items()):
                statuses = {role: (now - at, status) for role, (at, status) in vehicle.statuses.items()}
                values = Columns(_values(vehicle, statuses, now), padding=(0, 3, 0, 0))
                blocks += [Text(name, style="bold"), values, roles_view(statuses, width), Text("")]
            return Group(*blocks, *(Text(event) for event in self._events))


def _values(vehicle: Vehicle, statuses: Mapping[str, tuple[float, Status]], now: float) -> Iterator[Text]:
    """Attitude, error, voltages and payload, as far as they are those of now."""
    if vehicle.truth is not None:
        at, truth = vehicle.truth
        roll, pitch, yaw = (degrees(part) for part in to_euler(truth.attitude))
        text = f"roll {roll:+6.1f}°  pitch {pitch:+6.1f}°  yaw {yaw:+7.1f}°"
        yield Text(text) if now - at < SILENT_S else Text(f"no attitude for {duration(now - at)}", style=WAITING)
    at, telemetry = vehicle.telemetry or (now, None)
    session = _session(statuses)
    if session is None:
        if statuses:
            yield Text("no session: no error, no voltages", style=STALE)
        return
    if telemetry is None or telemetry.session != session:
        yield Text("no telemetry yet", style=WAITING)
    elif now - at >= SILENT_S:
        yield Text(f"no telemetry for {duration(now - at)}", style=WAITING)
    else:
        yield Text(f"error {degrees(angle(*telemetry.attitude_error)):5.2f}°")
        yield Text("voltages " + " ".join(f"{u:+6.1f}" for u in telemetry.voltages) + " V")
    if vehicle.settings is not None and "controller" in statuses:
        measured, commanded = vehicle.payload.bits_per_s(vehicle.settings.wire)
        yield Text(f"payload {measured / 1000:.1f} + {commanded / 1000:.1f} kbit/s")


def _session(statuses: Mapping[str, tuple[float, Status]]) -> str | None:
    """The session that runs, by the plant, or by the controller where there is no plant; None if that is silent."""
    age, status = statuses.get("plant") or statuses.get("controller") or (SILENT_S, None)
    return status.session if status is not None and age < SILENT_S else None


def watch(
    network: NetworkSettings,
    show: Callable[[Callable[[int], RenderableType], Text], None],
    stop: threading.Event,
    read: Callable[[float], str] | None,
) -> None:
    """Subscribe, and draw five times a second until `stop` is set or `q` is pressed.

    Args:
        network: The network to watch.
        show: Draws a view, given for a width, and a footer.
        stop: Ends it.
        read: Waits for keys up to a time [s]; None without a keyboard.

    Raises:
        NetworkError: The network cannot be joined.
    """
    top = Top()

    def receive(sample: zenoh.Sample) -> None:
        top.receive(str(sample.key_expr), sample.payload.to_bytes())

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            receive(reply.ok)

    with join(network, listen=False) as session:
        session.get(topics.key("status", "*"), answered, timeout=1.0)  # the next ones come within a second
        for name in ("status", "telemetry", "truth", "event"):
            session.declare_subscriber(topics.key(name, "*"), receive)
        queried = -inf
        while not stop.is_set():
            if time.monotonic() - queried > 2.0:  # for roles that have joined since
                queried = time.monotonic()
                session.get(topics.key("description", "*"), answered, timeout=1.0)
            show(top.draw, Text("q: quit" if read else "", style=STALE))
            if read is None:
                stop.wait(REFRESH_S)
            elif "q" in read(REFRESH_S):
                return
