"""Live view of the network, `op top`: every role of every vehicle, from its published messages.

Subscribes to status, telemetry, truth and events. What is shown is true now: values of a session that has ended are
left out, and what was not received for `SILENT_S` is marked with its age.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from math import degrees
from typing import Any, Final

import zenoh
from pydantic import ValidationError
from rich.console import Console, Group
from rich.live import Live

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status, Telemetry, Truth
from aeroloop.protocol.messages.operator import Message
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import angle, to_euler
from aeroloop.service.host.health import SILENT_S
from aeroloop.service.terminal.roles import duration, role_sheets
from aeroloop.service.terminal.show import drawn

REFRESH_S: Final = 0.2
EVENTS: Final = 5


Latest = dict[str, dict[tuple[str, str], tuple[float, Any]]]
"""By vehicle, and by topic and role, the last message with the time of its arrival on the clock [s]."""

MODELS: Final[dict[str, type[Message]]] = {"status": Status, "telemetry": Telemetry, "truth": Truth, "event": Event}


class Top:
    """Collects messages and draws them."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._latest: Latest = {}
        self._events: deque[str] = deque(maxlen=EVENTS)

    def receive(self, key: str, payload: bytes) -> None:
        """Take in a message of any topic; drops what it cannot parse, as it is of another version."""
        address = topics.read_key(key)
        if address is None or (model := MODELS.get(address.topic.name)) is None:
            return
        with self._lock, suppress(ValidationError):
            latest = self._latest.setdefault(address.vehicle, {})
            message = model.model_validate_json(payload)
            latest[address.topic.name, address.role or ""] = self._clock(), message
            if isinstance(message, Event):
                self._events.append(f"{time.strftime('%H:%M:%S')} {address.vehicle} {address.role}: {message.text}")

    def draw(self, width: int) -> Group:
        """The current view, for a terminal of this width."""
        with self._lock:
            now, blocks = self._clock(), list[Group]()
            for name, latest in sorted(self._latest.items()):
                ages = {each: (now - at, message) for each, (at, message) in latest.items()}
                statuses = {role: each for (topic, role), each in ages.items() if topic == "status"}
                values = "   ".join(_values(ages, statuses))
                blocks += [drawn(rows, title, width) for title, rows in (*role_sheets(statuses, name), (values, []))]
                blocks.append(drawn([], " ", width))
            events = "\n".join(self._events) if blocks else "no role on the network yet"
            return Group(*blocks, drawn([], events, width))


def _values(
    ages: Mapping[tuple[str, str], tuple[float, Any]], statuses: Mapping[str, tuple[float, Any]]
) -> Iterator[str]:
    """Attitude, error and voltages, as far as they are those of now."""
    if ("truth", "") in ages:
        age, truth = ages["truth", ""]
        roll, pitch, yaw = (degrees(part) for part in to_euler(truth.attitude))
        text = f"roll {roll:+6.1f}°  pitch {pitch:+6.1f}°  yaw {yaw:+7.1f}°"
        yield text if age < SILENT_S else f"no attitude for {duration(age)}"
    # The session that runs, by the plant, or by the controller where there is no plant.
    age, status = statuses.get("plant") or statuses.get("controller") or (SILENT_S, None)
    session = status.session if status is not None and age < SILENT_S else None
    age, telemetry = ages.get(("telemetry", ""), (0.0, None))
    if session is None:
        if statuses:
            yield "no session: no error, no voltages"
    elif telemetry is None or telemetry.session != session:
        yield "no telemetry yet"
    elif age >= SILENT_S:
        yield f"no telemetry for {duration(age)}"
    else:
        yield f"error {degrees(angle(*telemetry.attitude_error)):5.2f}°"
        yield "voltages " + " ".join(f"{u:+6.1f}" for u in telemetry.voltages) + " V"


def watch(network: NetworkSettings) -> None:
    """Subscribe, and draw five times a second until ^C.

    Raises:
        NetworkError: The network cannot be joined.
    """
    top, console = Top(), Console()

    def receive(sample: zenoh.Sample) -> None:
        top.receive(str(sample.key_expr), sample.payload.to_bytes())

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            receive(reply.ok)

    with (
        join(network, listen=False) as session,
        Live(console=console, auto_refresh=False, screen=console.is_terminal) as live,
    ):
        session.get(topics.key("status", "*"), answered, timeout=1.0)  # the next ones come within a second
        for name in MODELS:
            session.declare_subscriber(topics.key(name, "*"), receive)
        with suppress(KeyboardInterrupt):
            while True:
                live.update(top.draw(console.width), refresh=True)
                time.sleep(REFRESH_S)
