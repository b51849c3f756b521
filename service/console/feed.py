"""Feed of the console: what is published of every vehicle, as the newest states and the last minute of columns.

A client of the network that only subscribes. The plant's trace has every tick's measurement, voltages and latency, of
which at most `ROWS_HZ` a second are kept; what the controller computes is held from its telemetry. Sans-I/O: a message
is a key and bytes, and time is an argument.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from math import degrees, nan, sqrt
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Status, Telemetry
from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.trace import NEVER, Batch, Outcome, Sent, read_batch
from aeroloop.protocol.wire.attitude import IDENTITY, angle, received_quaternion, to_euler
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.host.health import replaces
from aeroloop.service.host.operator import Gathered
from aeroloop.service.review.panels import state_panels
from aeroloop.service.review.report import Findings, Line, Panel, Report
from aeroloop.service.theorem.certificate import Certificate

LAST_S: Final = 60.0
"""What of the columns is kept and shown."""
ROWS_HZ: Final = 50.0
EVENTS: Final = 200
DESCRIBED: Final = 16
"""Processes of a vehicle whose descriptions are kept."""
SHOWN: Final = ("description", "status", "telemetry", "event", "trace")

Column = tuple[str, str, str]  # group of panels, panel, quantity


def panels_of(settings: Settings, radius: float | None) -> list[Panel]:
    """Panels of a live page, without any value; of `radius` is a bound on ‖z‖, if one is proven."""
    nothing = np.empty(0)

    def panel(group: str, title: str, label: str, unit: str, *quantities: str) -> Panel:
        return Panel(
            group, title, label, unit, [Line(name, nothing, name in ("desired", "bound")) for name in quantities]
        )

    both = ("measured", "desired")
    angles = [panel("angles", "Roll, pitch and yaw", name, "°", *both) for name in ("roll", "pitch", "yaw")]
    attitude = [panel("attitude", "Attitude", name, "1", *both) for name in ("η", "ε₁", "ε₂", "ε₃")]
    errors = [panel("error", "Attitude error", f"ε̃{i}", "1", "measured") for i in "₁₂₃"]
    motors = [panel("input", "Input", f"u{'₁₂₃₄₅₆₇₈'[i - 1]}", "V", "commanded") for i in settings.wire.motors]
    found = [*angles, panel("error_angle", "Attitude error, as an angle", "angle", "°", "measured"), *errors, *motors]
    if not settings.loop.lockstep:
        found.append(panel("latency", "Loop latency", "latency", "ms", "latency"))
    with suppress(AeroloopError):  # a law of one's own may not be installed here
        for drawn in state_panels(settings):
            found += [panel(drawn.name, drawn.title, label, drawn.unit, "estimated") for label in drawn.labels]
    if radius is not None:
        found.append(panel("theorem", "Error of Theorem 1", "‖z‖", "1", "measured", "bound"))
    return [*found, *attitude]


class Vehicle:
    """What is known of one vehicle."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.statuses: dict[str, tuple[float, Status]] = {}  # by role, with when it was received [s]
        self._described: dict[tuple[str, str], Description] = {}  # by role and process, the newest last
        self._sources: tuple[Description | None, ...] = ()  # descriptions of the plant and the controller in use
        self.telemetry: deque[Telemetry] = deque(maxlen=16)  # of the session, the newest last
        self.settings: Settings | None = None  # of the controller, else of the plant
        self._wire: WireSpec | None = None  # of the plant, else of the controller
        self.radius: float | None = None  # of ‖z‖, where it is proven
        self.verdict = ""  # of the certificate
        self.panels: list[Panel] = []
        self.session = ""
        self.rows: deque[list[float]] = deque(maxlen=round(LAST_S * ROWS_HZ))  # time, then a value a column
        self.count = 0  # rows of the session so far, so that a page knows which it lacks
        self.generation = 0  # of the description; a page with another one is loaded anew
        self._sent_us: deque[tuple[int, int]] = deque(maxlen=256)  # session tick, and when its measurement was sent
        self._attitude = IDENTITY
        self._level: Callable[[float], float] = float  # of an attitude's code

    def describe(self, description: Description) -> None:
        """Take a role's description; of the ends it says how frames are read and what is drawn."""
        if description.role not in ("plant", "controller"):
            return
        process = description.role, description.facts.get("process", "")
        self._described.pop(process, None)
        self._described[process] = description
        if len(self._described) > DESCRIBED:
            unused = (process for process, each in self._described.items() if each not in self._sources)
            del self._described[next(unused)]
        self.follow_descriptions()

    def follow_descriptions(self) -> None:
        """Use the descriptions of the processes whose statuses are shown: of controllers, of that with the session."""
        plant, controller = self._description_of("plant"), self._description_of("controller")
        if (plant, controller) == self._sources:
            return
        self._sources = plant, controller
        source = controller or plant
        if source is None:
            return
        with suppress(ConfigError):
            settings = from_description(source.config)
            # The plant's frames are read as the plant describes them; a claim is granted for the same wire only.
            self._wire = from_description(plant.config).wire if plant is not None else settings.wire
            self._level = self._wire.attitude.quantizer().level
            self.settings = settings
            self.radius, self.verdict = None, ""
            with suppress(ValidationError):  # none, or of another version
                certificate = Certificate.model_validate(source.certificate)
                self.radius, self.verdict = certificate.plant_radius, certificate.verdict
                if not (certificate.holds and isinstance(self.settings.law, AdaptiveSettings)):
                    self.radius = None
            self.panels = panels_of(self.settings, self.radius)
            self.generation += 1
            self.rows.clear()

    def _description_of(self, role: str) -> Description | None:
        """The description of the process whose status is shown; of none such the newest of the role."""
        of_role = [each for (described_role, _), each in self._described.items() if described_role == role]
        if role in self.statuses:
            _, status = self.statuses[role]
            of_role = [self._described[role, status.process]] if (role, status.process) in self._described else of_role
        return of_role[-1] if of_role else None

    @property
    def columns(self) -> list[Column]:
        """What the values of a row after its time are."""
        return [(each.group, each.label, line.label) for each in self.panels for line in each.lines]

    def report(self) -> Report:
        """A run without any tick, for the page."""
        findings = Findings.model_construct(marks=[], faults=[], gaps=[])
        configuration = self.settings.description() if self.settings else {}
        return Report(self.name, findings, np.empty(0), self.panels, 1, configuration)

    def add(self, batch: Batch) -> None:
        """Add rows of the plant's trace."""
        settings, wire, columns = self.settings, self._wire, batch.columns
        if (
            settings is None
            or wire is None
            or batch.header.end != "plant"
            or not batch.header.session
            or not batch.header.rows
        ):
            return
        if batch.header.measurement_bytes != wire.measurement.size:
            return
        if batch.header.session != self.session:
            self.session, self.count = batch.header.session, 0
            self.rows.clear()
            self._sent_us.clear()
        stride = max(1, round(settings.loop.rate_hz / ROWS_HZ))
        base_us = batch.header.monotonic_ns // 1000
        for i, tick in enumerate(columns["session_tick"].tolist()):
            if columns["sent_as"][i] == Sent.FRAME:
                self._sent_us.append((tick, base_us + int(columns["sent"][i])))
                self._read(wire, columns["measurement"][i].tobytes())
            if tick % stride == 0:
                latency = self._latency_ms(columns, i, base_us)
                self.rows.append(self._row(settings, tick, columns["voltages"][i].tolist(), latency))
                self.count += 1

    def _read(self, wire: WireSpec, frame: bytes) -> None:
        """Take the attitude of a measurement."""
        if (read := wire.measurement.unpack(frame)) is None:
            return
        x, y, z = map(self._level, read[1][:3])
        if x == x and y == y and z == z:
            self._attitude = received_quaternion(x, y, z, self._attitude)

    def _latency_ms(self, columns: Mapping[str, Any], i: int, base_us: int) -> float:
        """From a measurement sent to its answer received, of the command that acted at a row; NaN where none did."""
        answered, received = int(columns["answered"][i]), int(columns["received"][i])
        if columns["outcome"][i] != Outcome.ACTED or NEVER in (answered, received):
            return nan
        sent = next((at for tick, at in reversed(self._sent_us) if tick == answered), None)
        return nan if sent is None else (base_us + received - sent) * 1e-3

    def _row(self, settings: Settings, tick: int, voltages: Sequence[float], latency: float) -> list[float]:
        """Values of all columns at a tick, by groups in the order of `panels_of`."""
        # what the controller computed last by then; a batch of the trace comes after the telemetry of its ticks
        its = (each for each in reversed(self.telemetry) if each.session == self.session and each.tick <= tick)
        seen, known = self._attitude, next(its, None)
        desired: tuple[float, ...] = known.desired if known else (nan,) * 4
        if known and sum(a * b for a, b in zip(seen, desired, strict=True)) < 0:
            desired = tuple(-part for part in desired)
        error = known.attitude_error if known else (nan,) * 3
        values = {
            "angles": [each for pair in zip(_angles(seen), _angles(desired), strict=True) for each in pair],
            "attitude": [each for pair in zip(seen, desired, strict=True) for each in pair],
            "error_angle": [degrees(angle(*error)) if known else nan],
            "error": error,
            "input": voltages,
            "latency": [latency],
            "theorem": [_z(settings, known), self.radius or nan],
            **(known.state if known else {}),
        }
        parts = {group: iter(numbers) for group, numbers in values.items()}
        groups = (each.group for each in self.panels for _ in each.lines)
        return [tick * settings.loop.period, *(next(parts.get(group, iter(())), nan) for group in groups)]


def _angles(q: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(degrees, to_euler((q[0], q[1], q[2], q[3])))) if q[0] == q[0] else (nan,) * 3


def _z(settings: Settings, known: Telemetry | None) -> float:
    """‖z‖ of the measurement, of the paper's law with its configured gains; else NaN."""
    if known is None or not isinstance(settings.law, AdaptiveSettings):
        return nan
    eps, sign = known.attitude_error, known.state.get("sign", (1.0,))[0]
    eta = sqrt(max(0.0, 1 - sum(part * part for part in eps)))
    z2 = [w + sign * c * e for w, c, e in zip(known.rate_error, settings.law.C1, eps, strict=True)]
    return sqrt((1 - eta) ** 2 + sum(part * part for part in (*eps, *z2)))


class Feed:
    """All vehicles of a network. Its lock is held while messages are taken and while a page's block is made."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.vehicles: dict[str, Vehicle] = {}
        self.events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=EVENTS)
        self._numbered = 0

    def take(self, key: str, payload: bytes, now_s: float, wall_s: float) -> None:
        """Take a message; what cannot be read, as of another version, is dropped."""
        address = topics.read_key(key)
        if address is None or address.topic.name not in SHOWN:
            return
        with self.lock, suppress(ValidationError, MessageError, ValueError, KeyError):
            vehicle = self.vehicles.setdefault(address.vehicle, Vehicle(address.vehicle))
            match address.topic.name:
                case "description":
                    vehicle.describe(Description.model_validate_json(payload))
                case "status":
                    status, role = Status.decode(payload, extra="ignore"), address.role or ""
                    at, last = vehicle.statuses.get(role, (now_s, status))
                    if replaces(status, last, now_s - at):
                        vehicle.statuses[role] = now_s, status
                        vehicle.follow_descriptions()
                case "telemetry":
                    vehicle.telemetry.append(Telemetry.model_validate_json(payload))
                case "trace":
                    if (batch := read_batch(payload)) is not None:
                        vehicle.add(batch)
                case _:
                    event = Event.model_validate_json(payload)
                    shown = {"at": wall_s, "vehicle": address.vehicle, "role": address.role or event.role}
                    self._numbered += 1
                    shown |= {"kind": event.kind, "text": event.text, "tick": event.tick, "session": event.session}
                    self.events.append((self._numbered, shown))

    def gathered(self, now_s: float) -> Gathered:
        """Statuses by vehicle and role, each with its age, as `op status` has them."""
        statuses = {
            name: {
                role: status.model_copy(update={"age_s": now_s - at}) for role, (at, status) in vehicle.statuses.items()
            }
            for name, vehicle in self.vehicles.items()
        }
        return Gathered({name: roles for name, roles in statuses.items() if roles}, [])

    def block(self, name: str, rows_after: int, events_after: int, session: str) -> dict[str, Any]:
        """Rows and events that a page lacks: of rows those that are still kept, of a new session all; NaN: unknown."""
        events = [event for number, event in self.events if number > events_after]
        found: dict[str, Any] = {"events": events, "numbered": self._numbered}
        if (vehicle := self.vehicles.get(name)) is not None:
            lacks = vehicle.count - (rows_after if session == vehicle.session else 0)
            kept = len(vehicle.rows)
            rows = list(islice(vehicle.rows, max(0, kept - lacks), kept))
            found |= {"session": vehicle.session, "count": vehicle.count, "generation": vehicle.generation}
            found["rows"] = [[round(x, 6) for x in row] for row in rows]
        return found
