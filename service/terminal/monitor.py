"""Live view of the network, `op top`: every role of every vehicle, from its published messages.

What is shown is true now: values of a session that has ended are left out, and what is silent is marked with its age.
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

MODELS: Final[dict[str, type[Message]]] = {"status": Status, "telemetry": Telemetry, "truth": Truth, "event": Event}


class Top:
    """Collects messages and draws them: of each vehicle the last one by topic and role, with its time [s]."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._latest: dict[str, dict[tuple[str, str], tuple[float, Any]]] = {}
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
                statuses = {
                    role: message.model_copy(update={"age_s": age})
                    for (topic, role), (age, message) in ages.items()
                    if topic == "status"
                }
                values = "   ".join(_values(ages, statuses))
                sheets = (*role_sheets(statuses, name), (values, []), (" ", []))
                blocks += [drawn(rows, title, width) for title, rows in sheets]
            events = "\n".join(self._events) if blocks else "no role on the network yet"
            return Group(*blocks, drawn([], events, width))


def _values(ages: Mapping[tuple[str, str], tuple[float, Any]], statuses: Mapping[str, Status]) -> Iterator[str]:
    """Attitude, error and voltages, as far as they are those of now."""
    if ("truth", "") in ages:
        age, truth = ages["truth", ""]
        roll, pitch, yaw = map(degrees, to_euler(truth.attitude))
        text = f"roll {roll:+6.1f}°  pitch {pitch:+6.1f}°  yaw {yaw:+7.1f}°"
        yield text if age < SILENT_S else f"no attitude for {duration(age)}"
    # The session that runs, by the plant, or by the controller where there is no plant.
    status = statuses.get("plant") or statuses.get("controller")
    session = status.session if status is not None and status.age_s < SILENT_S else None
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
    """Subscribe, and draw five times a second until ^C. Raises NetworkError if the network cannot be joined."""
    top, console = Top(), Console()

    def receive(sample: zenoh.Sample) -> None:
        top.receive(str(sample.key_expr), sample.payload.to_bytes())

    live = Live(console=console, auto_refresh=False, screen=console.is_terminal)
    with join(network, listen=False) as session, live:
        for name in MODELS:  # a status comes within a second
            session.declare_subscriber(topics.key(name, "*"), receive)
        with suppress(KeyboardInterrupt):
            while True:
                live.update(top.draw(console.width), refresh=True)
                time.sleep(REFRESH_S)
